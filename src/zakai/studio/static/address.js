// The state of the page in its address: after #, deflated and in base64url. It holds the model, which record, and the method.

const KEPT = ["text", "data", "method", "options", "coordinate", "tab", "until"];

export async function encoded(state) {
  const kept = Object.fromEntries(KEPT.map((key) => [key, state[key]]));
  const bytes = await through(new TextEncoder().encode(JSON.stringify(kept)), new CompressionStream("deflate-raw"));
  let letters = "";
  for (const byte of bytes) letters += String.fromCharCode(byte);
  return btoa(letters).replace(/\+/g, "-").replace(/\//g, "_").replace(/=+$/, "");
}

/** Return the state in an address, or null where there is none that can be read. */
export async function decoded(hash) {
  const letters = hash.replace(/^#/, "").replace(/-/g, "+").replace(/_/g, "/");
  if (letters.length < 8 || letters.length > 2_000_000) return null;
  try {
    const bytes = Uint8Array.from(atob(letters), (letter) => letter.charCodeAt(0));
    const found = JSON.parse(new TextDecoder().decode(await through(bytes, new DecompressionStream("deflate-raw"))));
    if (typeof found.text !== "string" || typeof found.data !== "object") return null;
    return Object.fromEntries(KEPT.filter((key) => key in found).map((key) => [key, found[key]]));
  } catch {
    return null;
  }
}

async function through(bytes, stream) {
  const reader = new Blob([bytes]).stream().pipeThrough(stream).getReader(), parts = [];
  let size = 0;
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    size += value.length;
    if (size > 4_000_000) throw new Error("too long"); // no model and no description of a record is
    parts.push(value);
  }
  const whole = new Uint8Array(size);
  let at = 0;
  for (const part of parts) { whole.set(part, at); at += part.length; }
  return whole;
}
