// Elements, numbers as text, and the small parts that every section uses.

/** Return a new element: properties, `class`, `data-…` and `aria-…` attributes, `on…` listeners, then children (texts or elements). */
export function h(name, properties = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(properties)) {
    if (value === undefined || value === null || value === false) continue;
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (key === "class") element.className = value;
    else if (key.includes("-") || key === "role" || key === "for" || key === "list") element.setAttribute(key, value === true ? "" : value);
    else element[key] = value;
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

export const byId = (id) => document.getElementById(id);

/** Return a number in a few digits, with a typographic minus sign. */
export function number(value, digits = 5) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  const plain = size === 0 || (size >= 1e-4 && size < 1e7);
  return (plain ? String(Number(value.toPrecision(digits))) : value.toExponential(digits - 1).replace(/\.?0+e/, "e")).replace(/-/g, "−");
}

export const counted = (count, noun) => `${count.toLocaleString("en")} ${noun}${count === 1 ? "" : "s"}`;

/** Fill a group of buttons of which one is pressed; `choose(value)` is called for another one. */
export function segments(group, options, chosen, choose) {
  group.replaceChildren(...options.map(({ value, text, testid }) => h("button", {
    type: "button", "aria-pressed": String(value === chosen), "data-testid": testid, onclick: () => value !== chosen && choose(value),
  }, text)));
}

/** Return a labelled field. */
export function field(label, input, hint) {
  return h("label", { class: "field" }, h("span", {}, label), input, hint ? h("small", {}, hint) : null);
}

/** Call `f` when it was not asked for again within some milliseconds. */
export function debounced(f, wait) {
  let timer = 0;
  const call = (...given) => { clearTimeout(timer); timer = setTimeout(() => f(...given), wait); };
  call.now = (...given) => { clearTimeout(timer); return f(...given); };
  return call;
}

/** Save bytes or text as a file of the reader. */
export function save(name, content, type = "application/octet-stream") {
  const address = URL.createObjectURL(new Blob([content], { type }));
  const link = h("a", { href: address, download: name });
  document.body.append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(address), 10_000);
}

/** Return a table of a header and rows of texts or elements. */
export function table(header, rows, name = "") {
  return h("div", { class: "scroll" }, h("table", { class: name },
    h("thead", {}, h("tr", {}, header.map((cell) => h("th", { scope: "col" }, cell)))),
    h("tbody", {}, rows.map((row) => h("tr", {}, row.map((cell) => h("td", {}, cell)))))));
}

const ALLOWED = new Set(["DIV", "P", "I", "SUB", "MATH", "MROW", "MI", "MN", "MO", "MTEXT", "MSUP", "MSUB", "MSUBSUP", "MFRAC", "MSQRT", "MROOT",
  "MFENCED", "MTABLE", "MTR", "MTD", "MSPACE", "MSTYLE", "MOVER", "MUNDER", "MUNDEROVER", "MPADDED"]);
const ATTRIBUTES = new Set(["displaystyle", "mathvariant", "width", "class", "close", "open", "separators", "linethickness"]);

const SMALLEST = 0.6; // of the size of a formula; a wider one is scrolled

/** Put text with MathML into an element: of the elements in it only those of formulas, smaller where they are too wide. */
export function formulas(target, text) {
  const parsed = new DOMParser().parseFromString(text, "text/html");
  for (const element of [...parsed.body.querySelectorAll("*")]) {
    if (!ALLOWED.has(element.tagName.toUpperCase())) { element.replaceWith(element.textContent); continue; }
    for (const { name } of [...element.attributes]) if (!ATTRIBUTES.has(name)) element.removeAttribute(name);
  }
  target.replaceChildren(...parsed.body.childNodes);
  for (const formula of target.querySelectorAll("math")) {
    const share = target.clientWidth / formula.getBoundingClientRect().width;
    if (share < 1) formula.style.fontSize = `${Math.max(SMALLEST, 0.98 * share) * parseFloat(getComputedStyle(formula).fontSize)}px`;
  }
}
