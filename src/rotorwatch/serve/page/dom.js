// Elements made of plain data: everything that comes from elsewhere goes in as text, never as HTML.
export const SIGNS = { healthy: "✓ Healthy", fault: "✕ Fault found", crashed: "✕ Crashed, not a rotor", ambiguous: "? Ambiguous", inconclusive: "? Inconclusive" };
const SVG = "http://www.w3.org/2000/svg";

function fill(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes ?? {})) {
    if (value === null || value === undefined || value === false) continue;
    if (name === "style") for (const [key, what] of Object.entries(value)) element.style.setProperty(key, what);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/** An HTML element. */
export function make(tag, attributes, ...children) {
  return fill(document.createElement(tag), attributes, children);
}

/** An SVG element. */
export function draw(tag, attributes, ...children) {
  return fill(document.createElementNS(SVG, tag), attributes, children);
}

/** Set a text only when it is another one: screen readers and selections are left in peace. */
export function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Set an attribute only when it is another one. */
export function mark(element, name, value) {
  if (element.getAttribute(name) !== String(value)) element.setAttribute(name, String(value));
}

/** 0.374 -> "37 %", as in reports. */
export function percent(share, digits = 0) {
  return `${(100 * share).toFixed(digits)}\u00a0%`;
}

/** The JSON that an address answers; null where it cannot be had: `trouble` gets a sentence, and whether the server has refused it. */
export async function fetched(address, trouble) {
  try {
    const answer = await fetch(address);
    if (answer.status === 401) location.reload();
    const data = await answer.json();
    if (answer.ok) return data;
    trouble(data.error, true);
  } catch {
    trouble("The server does not answer; is it still running?", false);
  }
  return null;
}
