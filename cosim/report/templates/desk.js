// Elements, requests and curves that the pages of a local server have in common.
/* global MINUS */
/* exported one, all, put, readable, post, extremesPath, tickLabels, gridPaths */

const one = (selector, root = document) => root.querySelector(selector);
const all = (selector, root = document) => [...root.querySelectorAll(selector)];
function make(name, attributes = {}, ...content) {
  const inSvg = ["svg", "g", "path", "rect", "circle"].includes(name),
    element = inSvg ? document.createElementNS("http://www.w3.org/2000/svg", name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes))
    if (value !== null && value !== undefined) element.setAttribute(key, value);
  element.append(...content);
  return element;
}
function put(element, content) {
  if (element.textContent !== content) element.textContent = content;
}

// Five significant digits, without an exponent where it can be read without one.
function readable(value) {
  if (value === null || value === undefined) return "–";
  if (typeof value !== "number") return String(value);
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  const short = size !== 0 && (size >= 1e6 || size < 1e-4) ? value.toExponential(3) : String(+value.toPrecision(5));
  return short.replaceAll("-", MINUS);
}

// The answer to a request with JSON; an answer that is an error is thrown with its reason.
async function request(path, content) {
  const answer = await fetch(path, {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(content),
  });
  if (!answer.ok) throw new Error((await answer.json()).error);
  return answer;
}
const post = async (path, content) => (await request(path, content)).json();

// The curve through the least and the largest value of each point, always to the nearer one first; NaN is a gap.
function extremesPath(count, x, low, high) {
  const parts = [];
  let before = null;
  for (let n = 0; n < count; n++) {
    let first = low(n),
      last = high(n);
    if (Number.isNaN(first)) {
      if (before !== null && parts.at(-1).startsWith("M")) parts.push("h0"); // a lone point is a dot
      before = null;
      continue;
    }
    if (before !== null && Math.abs(last - before) < Math.abs(first - before)) [first, last] = [last, first];
    parts.push(`${before === null ? "M" : "L"}${x(n)} ${first}`);
    if (last !== first) parts.push(`V${last}`);
    before = last;
  }
  if (parts.at(-1)?.startsWith("M")) parts.push("h1");
  return parts.join("");
}

const tickLabels = (ticks, side) => ticks.map((t) => make("span", { style: `${side}:${t.at.toFixed(2)}%` }, t.label));
const gridPaths = (x, y, width, height) => [
  ...y.ticks.map((t) => make("path", { d: `M0 ${Math.round(height - (height * t.at) / 100)}h${width}` })),
  ...x.ticks.map((t) => make("path", { d: `M${Math.round((width * t.at) / 100)} 0v${height}` })),
];
