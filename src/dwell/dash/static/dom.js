// Elements and numbers. Texts are set as text: the page never parses them as markup.

const SVG = "http://www.w3.org/2000/svg";

/** Write a text; HTML elements show the D of V_D as a subscript. */
const write = (element, text) => {
  const [first, ...parts] = element.namespaceURI === SVG ? [text] : String(text).split("V_D");
  element.replaceChildren(first, ...parts.flatMap((part) => ["V", make("sub", { text: "D" }), part]));
};

const put = (element, attributes, children) => {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name === "text") write(element, value);
    else if (name === "hue") element.style.setProperty("--hue", value);
    else if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child !== null));
  return element;
};

export const make = (tag, attributes = {}, ...children) =>
  put(document.createElement(tag), attributes, children);

export const draw = (tag, attributes = {}, ...children) =>
  put(document.createElementNS(SVG, tag), attributes, children);

/** Last text of each element. */
const said = new WeakMap();

/** Set the text of an element if it changes; screen readers announce every change. */
export const say = (element, text) => {
  if (said.get(element) === text) return;
  said.set(element, text);
  write(element, text);
};

export const number = (value, digits = 1) =>
  value === null || value === undefined || !Number.isFinite(value) ? "–" : value.toFixed(digits);

export const percent = (share, digits = 0) =>
  share === null || share === undefined ? "–" : `${(100 * share).toFixed(digits)} %`;

export const count = (value) => value.toLocaleString("en");

export const ago = (ms) => {
  if (ms === null || ms === undefined) return "–";
  if (ms < 9950) return `${(ms / 1000).toFixed(1)} s`;
  return ms < 120000 ? `${Math.round(ms / 1000)} s` : `${Math.round(ms / 60000)} min`;
};

/** Text of a place on the time line. */
export const place = (at, unit) => {
  if (unit === "cycle") return `cycle ${count(Math.floor(at))}`;
  return `${at.toLocaleString("en", { minimumFractionDigits: 1, maximumFractionDigits: 1 })} s`;
};

export const colour = (name) =>
  getComputedStyle(document.documentElement).getPropertyValue(name).trim();
