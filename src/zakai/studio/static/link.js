// The WebSocket to the studio: a request is JSON, an answer a binary frame (axes.js). Of requests of one channel the newest counts.

import { unpack } from "./axes.js";

export class Superseded extends Error {}

export class Link {
  constructor() {
    this.number = 0;
    this.waiting = new Map(); // number -> {channel, resolve, reject, progress, said, work}
    this.latest = new Map(); // channel -> number
    this.onhello = this.onlost = this.onstream = () => {};
    this.tries = 0;
  }

  /** Connect, again and again where the studio has gone, until it answers. */
  open() {
    const address = new URL("socket", document.baseURI);
    address.protocol = "ws:";
    this.socket = new WebSocket(address);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = ({ data }) => (typeof data === "string" ? this._told(JSON.parse(data)) : this._answered(unpack(data)));
    this.socket.onclose = ({ code }) => {
      for (const one of this.waiting.values()) one.reject(new Superseded("the connection has ended"));
      this.waiting.clear();
      if (code === 4001) return;
      this.onlost(this.tries === 0 ? "The connection to the studio has ended; trying again …"
        : "The studio does not answer. Start zakai studio again, and open the address that it prints.");
      this.tries += 1;
      setTimeout(() => this.open(), Math.min(5000, 500 * this.tries));
    };
  }

  _told(message) {
    if (message.do === "hello") { this.tries = 0; this.onhello(message); }
    if (message.do === "replaced") this.onlost("The studio is open in another window; reload this one to use it here.");
  }

  _answered({ header, arrays, shapes }) {
    if (["follow", "stream-begin", "stream-lines"].includes(header.do)) { this.onstream(header); return; }
    const one = this.waiting.get(header.id);
    if (!one) return; // an answer that came late
    if (header.do === "progress") { one.progress?.(header.done, header.total); return; }
    if (header.do === "said") { one.said?.(header.text); return; }
    this.waiting.delete(header.id);
    if (header.error) one.reject(Object.assign(new Error(header.error), { cancelled: Boolean(header.cancelled) }));
    else one.resolve({ ...header, arrays, shapes });
  }

  /** Ask for an answer; a promise, which an error of the studio or a newer request of the channel rejects. */
  ask(what, request = {}, { channel = what, progress, said, work } = {}) {
    const id = ++this.number;
    const before = this.waiting.get(this.latest.get(channel));
    if (before) {
      this.waiting.delete(this.latest.get(channel));
      before.reject(new Superseded("a newer request has taken its place"));
    }
    this.latest.set(channel, id);
    return new Promise((resolve, reject) => {
      if (this.socket?.readyState !== WebSocket.OPEN) { reject(new Error("the studio does not answer; start it again")); return; }
      this.waiting.set(id, { channel, resolve, reject, progress, said, work });
      this.socket.send(JSON.stringify({ ...request, do: what, id, channel }));
    });
  }

  /** End the requests that may take long; nobody waits for their answers any more. */
  drop() {
    for (const [id, one] of this.waiting) {
      if (!one.work) continue;
      this.waiting.delete(id);
      one.reject(new Superseded("a run has made it outdated"));
    }
    this.tell("cancel");
  }

  /** Tell the studio something that has no answer. */
  tell(what, request = {}) {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ ...request, do: what, id: ++this.number }));
  }
}

/** Send a file to the studio, and return its number there. */
export async function upload(file, most) {
  if (file.size > most) throw new Error(`${file.name}: is larger than ${most >> 20} MiB; drop a part of it`);
  let answer;
  try {
    answer = await fetch(new URL("record", document.baseURI), { method: "POST", body: file });
  } catch {
    throw new Error(`${file.name}: did not reach the studio; drop it again`);
  }
  const said = await answer.json().catch(() => ({ error: "the studio refused the file; reload the page" }));
  if (said.error) throw new Error(`${file.name}: ${said.error}`);
  return said;
}
