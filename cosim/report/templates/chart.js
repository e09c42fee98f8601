// Charts of all pages: axes, curves, cursor, zoom, keys, files. What is linked shares its x axis and its cursor.
/* exported MOST_AXES, COLOURS, one, all, safeName, extremes, Linked, Chart */

const MINUS = "\u2212",
  MISSING = "\u2013",
  MOST_AXES = 4,
  COLOURS = 6;

// The namespace of pictures, as the browser knows it: a page names no address.
const SVG = new DOMParser().parseFromString("<svg></svg>", "text/html").querySelector("svg").namespaceURI;

// -- elements and files ------------------------------------------------------------------------------
const one = (selector, root = document) => root.querySelector(selector);
const all = (selector, root = document) => [...root.querySelectorAll(selector)];
function make(name, attributes = {}, ...content) {
  const inSvg = ["svg", "g", "path", "rect"].includes(name),
    element = inSvg ? document.createElementNS(SVG, name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes))
    if (value !== null && value !== undefined) element.setAttribute(key, value);
  element.append(...content);
  return element;
}
function button(words, action, attributes = {}) {
  const made = make("button", { type: "button", ...attributes }, words);
  made.addEventListener("click", action);
  return made;
}
function put(element, content) {
  if (element && element.textContent !== content) element.textContent = content;
}
const escapeText = (text) => text.replace(/[&<>"]/g, (c) => `&#${c.charCodeAt(0)};`);
function tag(name, attributes, inner = "") {
  const pairs = Object.entries(attributes).map(([key, value]) => ` ${key}="${escapeText(String(value))}"`);
  return `<${name}${pairs.join("")}>${inner}</${name}>`;
}
const style = (element, ...names) => {
  const look = getComputedStyle(element);
  return Object.fromEntries(names.map((name) => [name, look.getPropertyValue(name).trim().replaceAll("px", "")]));
};
function save(content, name) {
  const address = URL.createObjectURL(content);
  make("a", { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 10000);
}
function savePng(svg, name) {
  const image = new Image();
  image.onload = () => {
    const canvas = make("canvas", { width: 2 * image.width, height: 2 * image.height });
    canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
    canvas.toBlob((content) => save(content, name));
  };
  image.src = "data:image/svg+xml;charset=utf-8," + encodeURIComponent(svg);
}
const safeName = (text) =>
  text
    .replace(/°/g, "deg")
    .replace(/%/g, "percent")
    .replace(/[^\p{L}\p{N}\p{M}.-]+/gu, "_")
    .slice(0, 80);

// -- numbers -----------------------------------------------------------------------------------------
// Five significant digits, without an exponent where it can be read without one.
function readable(value) {
  if (value === null || value === undefined || Number.isNaN(value)) return MISSING;
  if (typeof value !== "number") return String(value);
  const size = Math.abs(value);
  const short = size !== 0 && (size >= 1e6 || size < 1e-4) ? value.toExponential(3) : String(+value.toPrecision(5));
  return short.replaceAll("-", MINUS);
}
// Fixed decimals with a true minus sign, and no minus before zero.
function fixed(value, digits) {
  const text = value.toFixed(digits);
  return text.replace("-", Number(text) === 0 ? "" : MINUS);
}

// -- axes --------------------------------------------------------------------------------------------
function roundStep(least, angle) {
  if (angle && least > 10 && least <= 360) return [15, 30, 45, 90, 180, 360].find((part) => part >= least);
  const power = 10 ** Math.floor(Math.log10(least));
  return power * ([1, 2, 2.5, 5].find((m) => m * power >= least * (1 - 1e-9)) ?? 10);
}
// Round ticks, about a number of them; huge and tiny ones share a power of ten.
function axis(low, high, number, angle = false) {
  if (high - low <= 1e-9 * Math.max(Math.abs(low), Math.abs(high))) {
    const room = 0.1 * Math.abs(low) || 1;
    [low, high] = [low - room, high + room];
  }
  const step = roundStep((high - low) / number, angle);
  const largest = Math.max(Math.abs(low), Math.abs(high));
  const power = largest >= 1e-3 && largest < 1e6 ? 0 : 3 * Math.floor(Math.log10(largest) / 3 + 1e-9);
  const unit = step / 10 ** power;
  let decimals = Math.max(0, -Math.floor(Math.log10(unit) + 1e-9));
  if (Math.abs(unit * 10 ** decimals - Math.round(unit * 10 ** decimals)) > 1e-6) decimals++;
  const ticks = [];
  for (let i = Math.ceil(low / step - 1e-9); i <= Math.floor(high / step + 1e-9); i++)
    ticks.push({ at: (i * step - low) / (high - low), label: fixed(i * unit, Math.min(decimals, 20)) });
  const raised = String(power).replace(/./g, (c) => "⁰¹²³⁴⁵⁶⁷⁸⁹⁻"["0123456789-".indexOf(c)]);
  return { low, high, ticks, factor: power ? `×10${raised}` : "" };
}
// Over 10^low … 10^high: decades, or in fewer than three what is round between them.
function logAxis(low, high) {
  const every = Math.max(1, Math.ceil((high - low) / 8)),
    first = Math.floor(low),
    at = (value) => (Math.log10(value) - low) / (high - low);
  const decades = Array.from({ length: Math.ceil(high) - first + 1 }, (_, k) => first + k).filter((d) => !(d % every));
  for (const parts of [[1], [1, 2, 5], [1, 2, 3, 4, 5, 6, 7, 8, 9]]) {
    const values = decades.flatMap((d) => parts.map((m) => m * 10 ** d));
    const ticks = values.filter((v) => at(v) > -1e-9 && at(v) < 1 + 1e-9);
    if (ticks.length >= 3)
      return { low, high, ticks: ticks.map((v) => ({ at: at(v), label: readable(v) })), factor: "" };
  }
  const linear = axis(10 ** low, 10 ** high, 6);
  const place = (share) => at(linear.low + share * (linear.high - linear.low));
  return { ...linear, low, high, ticks: linear.ticks.map((t) => ({ at: place(t.at), label: t.label })) };
}

// -- points ------------------------------------------------------------------------------------------
// The place of the last value up to another, −1 before the first.
function lastUpTo(values, limit) {
  let low = 0,
    high = values.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (values[middle] <= limit) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}
// Rows in sight and one beyond each end; many of them by their least and largest value in each pixel column, so that
// no peak is lost. Behind a row of `breaks` a gap begins.
function extremes(x, v, { from, to }, columns, breaks = []) {
  const end = Math.min(x.length, lastUpTo(x, to) + 2);
  let first = Math.max(0, lastUpTo(x, from));
  while (first > 0 && x[first] === x[first - 1]) first--;
  if (end - first <= 2 * columns && !breaks.length) {
    const low = v.subarray(first, end);
    return { x: x.subarray(first, end), low, high: low, first };
  }
  const pixel = end - first > 2 * columns ? (to - from) / columns : 0,
    points = { x: [], low: [], high: [], first };
  const add = (at, low, high) => points.x.push(at) && points.low.push(low) && points.high.push(high);
  let coming = breaks.findIndex((row) => row > first);
  for (let row = first; row < end;) {
    const until = pixel ? from + (Math.floor((x[row] - from) / pixel) + 1) * pixel : -Infinity,
      begin = x[row];
    let low = NaN,
      high = NaN;
    if (coming >= 0 && breaks[coming] <= row) {
      add(begin, NaN, NaN);
      coming = coming + 1 < breaks.length ? coming + 1 : -1;
    }
    do {
      const value = v[row++];
      if (!(value >= low)) low = Number.isNaN(value) ? low : value;
      if (!(value <= high)) high = Number.isNaN(value) ? high : value;
    } while (row < end && x[row] < until && !(coming >= 0 && breaks[coming] <= row));
    add((begin + x[row - 1]) / 2, low, high);
  }
  return points;
}

// -- shapes ------------------------------------------------------------------------------------------
const round = (value) => Math.round(10 * value) / 10;
// A line through the least and the largest value of each point, always to the nearer one first; NaN is a gap, and a
// sample between two gaps a cross.
function linePath({ x, low, high }, u, v, isHeld) {
  const parts = [];
  let before = null,
    isAlone = false;
  for (let n = 0; n < x.length; n++) {
    let [first, last] = [v(low[n]), v(high[n])];
    if (Number.isNaN(first + x[n])) {
      if (isAlone) parts.push("m-3.5 0h7m-3.5 -3.5v7");
      before = null;
      isAlone = false;
      continue;
    }
    if (before !== null && Math.abs(last - before) < Math.abs(first - before)) [first, last] = [last, first];
    isAlone = before === null && first === last;
    parts.push(before === null ? `M${u(x[n])} ${first}` : isHeld ? `H${u(x[n])}V${first}` : `L${u(x[n])} ${first}`);
    if (last !== first) parts.push(`V${last}`);
    before = last;
  }
  if (isAlone) parts.push("m-3.5 0h7m-3.5 -3.5v7");
  return parts.join("");
}
const MARKS = {
  dots: (a, b) => `M${a} ${b}h0`,
  crosses: (a, b) => `M${a - 4} ${b - 4}l8 8m-8 0l8 -8`,
  stems: (a, b, zero) => `M${a} ${zero}V${b}`,
  bars: (a, b, zero, top) => `M${a - 3} ${b}h6m-3 0V${top}m-3 0h6`,
};
function markPath(curve, { x, low, upper }, u, v) {
  const parts = [];
  for (let n = 0; n < x.length; n++)
    if (!Number.isNaN(low[n]))
      parts.push(MARKS[curve.form](u(x[n]), v(low[n]), v(0), upper && v(upper[n])));
  return parts.join("");
}
// The region between two lines over the same points.
function bandPath(lower, upper, u, v) {
  const parts = [];
  for (let n = 0, begin = 0; n <= lower.x.length; n++) {
    if (n < lower.x.length && !Number.isNaN(lower.low[n] + upper.high[n])) continue;
    const rows = Array.from({ length: n - begin }, (_, k) => begin + k);
    const edge = (part, some) => some.map((k) => `${u(lower.x[k])} ${v(part[k])}`);
    if (rows.length) parts.push(`M${[...edge(upper.high, rows), ...edge(lower.low, rows.reverse())].join("L")}z`);
    begin = n + 1;
  }
  return parts.join("");
}

// A browser strokes a hundred paths of extremes in seconds, and fills their columns of pixels in milliseconds.
function paintCurves(canvas, { width: wide, height: high }, curves, x) {
  const ratio = devicePixelRatio || 1,
    [width, height] = [wide, high].map((size) => Math.max(1, Math.round(size * ratio)));
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height }); // a new surface
  const context = canvas.getContext("2d"),
    picture = context.createImageData(width, height),
    [top, bottom] = [new Float32Array(width), new Float32Array(width)];
  for (const { points, y, pen } of curves) {
    fillColumns(points, x, y, height, top, bottom);
    context.fillStyle = pen.stroke; // in any notation; it is read back as #rrggbb
    const dash = pen["stroke-dasharray"] === "none" ? null : [6 * ratio, 10 * ratio];
    inkColumns(picture, top, bottom, context.fillStyle, (Number(pen["stroke-width"]) * ratio) / 2, dash);
  }
  context.putImageData(picture, 0, 0);
}
// The highest and the lowest place of a curve in each column of pixels; a column without the curve has top > bottom.
function fillColumns({ x: t, low, high }, x, y, height, top, bottom) {
  const width = top.length,
    along = width / (x.high - x.low),
    upward = height / (y.high - y.low);
  top.fill(Infinity);
  bottom.fill(-Infinity);
  let before = NaN,
    from = 0;
  for (let n = 0; n < t.length; n++) {
    const place = (t[n] - x.low) * along,
      near = height - (low[n] - y.low) * upward,
      far = height - (high[n] - y.low) * upward,
      isTurned = Math.abs(far - before) < Math.abs(near - before),
      first = isTurned ? far : near;
    if (!Number.isNaN(before + first) && place >= 0 && from < width) {
      const slope = place > from ? (first - before) / (place - from) : 0,
        end = Math.min(width - 1, Math.floor(place));
      for (let k = Math.max(0, Math.floor(from)); k <= end; k++) {
        const begin = before + slope * (Math.max(from, k) - from),
          stop = before + slope * (Math.min(place, k + 1) - from);
        top[k] = Math.min(top[k], begin, stop);
        bottom[k] = Math.max(bottom[k], begin, stop);
      }
    }
    const k = Math.floor(place);
    if (!Number.isNaN(near) && k >= 0 && k < width) {
      top[k] = Math.min(top[k], far);
      bottom[k] = Math.max(bottom[k], near);
    }
    before = isTurned ? near : far;
    from = place;
  }
}
// Ink from half a line above the top to half a line below the bottom; pixels at the ends are covered in part.
function inkColumns({ data, width, height }, top, bottom, colour, half, dash) {
  const ink = [1, 3, 5].map((k) => parseInt(colour.slice(k, k + 2), 16));
  for (let k = 0; k < width; k++) {
    if (top[k] > bottom[k] || (dash && k % dash[1] >= dash[0])) continue;
    const [high, low] = [top[k] - half, bottom[k] + half],
      end = Math.min(height, Math.ceil(low));
    for (let row = Math.max(0, Math.floor(high)); row < end; row++) {
      const at = 4 * (row * width + k),
        share = Math.min(low, row + 1) - Math.max(high, row),
        under = (data[at + 3] / 255) * (1 - share),
        whole = share + under;
      for (let part = 0; part < 3; part++) data[at + part] = (ink[part] * share + data[at + part] * under) / whole;
      data[at + 3] = 255 * whole;
    }
  }
}

// -- linked charts -----------------------------------------------------------------------------------
// Charts over one x axis: what is in sight, and the cursor. A page says what a cursor, a click and a key do.
class Linked {
  constructor(from, to) {
    Object.assign(this, {
      whole: { from, to },
      view: { from, to },
      charts: [],
      cursor: null,
      least: 1e-9 * (to - from),
    });
  }
  get extent() {
    return this.whole;
  }
  get isWhole() {
    return this.view.from === this.extent.from && this.view.to === this.extent.to;
  }
  look(from, to) {
    const { from: begin, to: end } = this.whole,
      width = Math.max(this.least, Math.min(to - from, end - begin)),
      start = Math.max(begin, Math.min(end - width, (from + to - width) / 2));
    this.view = { from: start, to: width === end - begin ? end : start + width };
    this.looked();
  }
  home() {
    for (const each of this.charts.flatMap((chart) => chart.axes)) each.range = null;
    this.look(this.extent.from, this.extent.to);
  }
  zoom(factor, about) {
    this.look(about - (about - this.view.from) * factor, about + (this.view.to - about) * factor);
  }
  pan(share) {
    const shift = share * (this.view.to - this.view.from);
    this.look(this.view.from + shift, this.view.to + shift);
  }
  // Sizes are read before anything is drawn: between two charts the browser would lay out the page for each of them.
  draw(charts = this.charts) {
    for (const chart of charts) chart.measure();
    for (const chart of charts) chart.draw();
  }
  // The cursor as a share of the picture's width.
  mark(...hosts) {
    const { from, to } = this.view,
      share = this.cursor === null ? -1 : (this.cursor - from) / (to - from);
    for (const host of hosts) {
      host.style.setProperty("--cursor", `${(100 * share).toFixed(3)}%`);
      host.classList.toggle("cursor-away", share < -1e-9 || share > 1 + 1e-9);
      host.classList.toggle("cursor-late", share > 0.8);
    }
  }
}

class Chart {
  // more: unit, over (label of the x axis), axes, levels, uprights, outside, band, reach, kind
  constructor(host, figure, more = {}) {
    Object.assign(this, { host, figure, kind: "time", unit: "", axes: [{ curves: [], range: null }], levels: [] });
    Object.assign(this, { uprights: [], outside: [], band: null, reach: null, over: "time [s]" }, more);
    this.svg = make("svg", { preserveAspectRatio: "none", "aria-hidden": "true" });
    this.canvas = make("canvas", { "aria-hidden": "true", hidden: "" });
    this.ring = make("span", { class: "ring", "aria-hidden": "true", hidden: "" });
    this.blank = make("span", { class: "blank" });
    this.when = make("span", { class: "when" });
    const cursor = make("span", { class: "cursor", "aria-hidden": "true" }, this.when),
      layers = [this.svg, this.canvas, this.blank, cursor, this.ring];
    this.box = make(
      "div",
      { class: "box", tabindex: 0, role: "application", "aria-roledescription": "chart" },
      ...layers,
    );
    this.legend = make("span", { class: "legend" });
    this.tools = make("span", { class: "tools" });
    this.grid = make("div", { class: "axes" });
    this.listen();
  }

  get curves() {
    return this.axes.flatMap((each) => each.curves);
  }
  labelOf(curve) {
    return curve.label;
  }
  headOf() {
    return "";
  }
  style = (curve) => curve.style;

  // Legend, axes and lines anew, after a change of the curves.
  build() {
    const { axes } = this,
      place = (element, row, column) => element.style.setProperty("grid-area", `${row} / ${column}`);
    this.legend.replaceChildren(...axes.flatMap((each, k) => each.curves.map((curve) => this.entry(curve, k))));
    this.shown = axes.map((each, k) => {
      const ticks = make("div", { class: `y-ticks${k ? " right" : ""}`, "aria-hidden": "true", "data-axis": k }),
        head = make("span", { class: "axis-unit", "aria-hidden": "true" }, this.headOf(each, k)),
        factor = make("span", { class: "factor", "aria-hidden": "true" });
      [head, ticks, factor].forEach((part, row) => place(part, row + 1, k ? 2 + k : 1));
      return { ticks, head, factor };
    });
    this.xTicks = make("div", { class: "x-ticks", "aria-hidden": "true" });
    this.xLabel = make("div", { class: "x-label", "aria-hidden": "true" }, `${this.over} `);
    this.xFactor = this.xLabel.appendChild(make("span"));
    const parts = this.shown.flatMap(({ ticks, head, factor }) => [head, ticks, factor]);
    this.grid.replaceChildren(...parts, this.box, this.xTicks, this.xLabel, this.tools);
    this.marks = {
      grid: make("g", { class: "grid" }),
      outside: make("path", { class: "outside" }),
      span: make("path", { class: "span" }),
      zero: make("path", { class: "zero" }),
      band: make("path", { class: "band" }),
      limit: make("path", { class: "limit" }),
      event: make("path", { class: "event" }),
      pin: make("path", { class: "pin" }),
    };
    this.lines = this.curves.map((curve) => make("path", { class: `line ${this.style(curve)}`, "data-line": "" }));
    this.svg.replaceChildren(...Object.values(this.marks), ...this.lines);
  }

  // A name in the legend, which hides and shows its curve.
  entry(curve) {
    const mark = { dots: "M11 4h0", crosses: "M8 1l6 6m-6 0l6 -6" }[curve.form] ?? "M0 4h22",
      swatch = make("svg", { class: "swatch", viewBox: "0 0 22 8", "aria-hidden": "true" });
    swatch.append(make("path", { class: `line ${this.style(curve)}`, d: mark }));
    const name = make("span", {}, this.labelOf(curve));
    curve.cell = make("output");
    if (this.curves.length < 2) return make("span", { class: "entry" }, swatch, name, curve.cell);
    const toggle = () => {
      curve.hidden = !curve.hidden;
      made.setAttribute("aria-pressed", String(!curve.hidden));
      this.host.draw([this]);
    };
    const made = button(swatch, toggle, {
      class: "entry",
      "aria-pressed": String(!curve.hidden),
      title: "show or hide",
    });
    made.append(name, curve.cell);
    return made;
  }

  // -- drawing -------------------------------------------------------------------------------------
  range(each) {
    if (each.range) return each.range;
    const { from, to } = this.kind !== "time" ? { from: -Infinity, to: Infinity } : this.host.view;
    let [low, high] = [Infinity, -Infinity];
    const see = (values) => {
      for (const value of values) {
        if (value < low) low = value;
        if (value > high) high = value;
      }
    };
    for (const { points, hidden, form } of each.curves) {
      if (!points || hidden) continue;
      const { x } = points;
      let [first, end] = [Math.max(0, lastUpTo(x, from)), Math.min(x.length, lastUpTo(x, to) + 2)];
      if (points.over) [first, end] = [0, x.length];
      for (const part of new Set([points.low, points.high, points.upper ?? points.low])) see(part.slice(first, end));
      if (form === "stems") see([0]);
    }
    if (this.host.isWhole && each === this.axes[0]) {
      see(this.levels);
      for (const edge of this.band?.points ?? []) see(edge.low);
    }
    if (low > high) return null;
    const margin = 0.06 * (high - low) || 0.1 * Math.abs(high) || 1;
    return this.host.isWhole && this.reach ? this.reach : [low - margin, high + margin];
  }
  ends() {
    return [this.host.view.from, this.host.view.to];
  }
  measure() {
    this.size = { width: this.box.clientWidth || 500, height: this.box.clientHeight || 190 };
    this.prepare?.();
  }
  scales(width = this.size.width) {
    const [from, to] = this.ends(),
      ys = this.axes.map((each) => {
        const range = this.range(each);
        return range ? axis(...range, 5, this.unit === "°") : { low: 0, high: 1, ticks: [], factor: "" };
      });
    if (this.host.log || this.isLog) return { x: logAxis(from, to), ys };
    const full = axis(from, to, width < 420 ? 4 : width > 700 ? 8 : 6),
      long = 9 * Math.max(0, ...full.ticks.map((t) => t.label.length)); // fewer ticks where their labels are long
    const x = long * full.ticks.length < width ? full : axis(from, to, Math.max(1, Math.floor(width / (long + 20))));
    return { x: { ...x, low: from, high: to > from ? to : from + 1 }, ys };
  }
  // The shapes of the marks and of the curves in a box at (left, top).
  paths({ x, ys }, { width, height }, { left = 0, top = 0, isPainted = false } = {}) {
    const u = (value) => round(left + width * Math.max(-9, Math.min(10, (value - x.low) / (x.high - x.low)))),
      along = (y) => (value) =>
        round(top + height * (1 - Math.max(-9, Math.min(10, (value - y.low) / (y.high - y.low))))),
      v = along(ys[0]),
      upright = (value) => (value >= x.low && value <= x.high ? `M${u(value)} ${top}v${height}` : ""),
      shade = ([from, to]) => `M${u(from)} ${top}H${u(to)}v${height}H${u(from)}z`,
      level = (value) => `M${left} ${v(value)}h${width}`;
    const { changes = [] } = this.host,
      marks = this.kind === "time" ? (this.host.marks ?? []) : [];
    const curves = this.axes.flatMap((each, k) =>
      each.curves.map((curve) => {
        if (!curve.points || curve.hidden || isPainted) return "";
        if (curve.form in MARKS) return markPath(curve, curve.points, u, along(ys[k]));
        const points = curve.points.over ? { ...curve.points, x: curve.points.over } : curve.points;
        return linePath(points, u, along(ys[k]), curve.form === "held");
      }),
    );
    return {
      zero: ys[0].low < 0 && ys[0].high > 0 ? level(0) : "",
      band: this.band?.points ? bandPath(...this.band.points, u, v) : "",
      limit: this.levels.map(level).join("") + this.uprights.map(upright).join(""),
      event: this.kind !== "time" ? "" : changes.map(({ at }) => upright(at)).join(""),
      outside: this.outside.map(shade).join(""),
      span: marks.length === 2 ? shade(marks) : "",
      pin: marks.map(upright).join(""),
      curves,
    };
  }
  draw() {
    const scales = this.scales(),
      { x, ys } = scales,
      { width, height } = this.size;
    const labels = (ticks, side) =>
      ticks.map((t) => make("span", { style: `${side}:${(100 * t.at).toFixed(2)}%` }, t.label));
    this.xTicks.replaceChildren(...labels(x.ticks, "left"));
    put(this.xFactor, x.factor);
    ys.forEach((y, k) => {
      this.shown[k].ticks.replaceChildren(...labels(y.ticks, "bottom"));
      put(this.shown[k].factor, y.factor);
    });
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.marks.grid.replaceChildren(
      ...ys[0].ticks.map((t) => make("path", { d: `M0 ${round(height * (1 - t.at))}h${width}` })),
      ...x.ticks.map((t) => make("path", { d: `M${round(width * t.at)} 0v${height}` })),
    );
    const isPainted = this.kind === "time" && this.host.isPainted,
      curves = this.curves;
    const paths = this.paths(scales, this.size, { isPainted });
    for (const [name, path] of Object.entries(paths)) if (name !== "curves") this.marks[name].setAttribute("d", path);
    this.lines.forEach((line, k) => line.setAttribute("d", paths.curves[k]));
    this.lines.forEach((line, k) => line.toggleAttribute("hidden", Boolean(curves[k].hidden)));
    this.canvas.hidden = !isPainted;
    if (isPainted) {
      const pens = new Map();
      const penOf = (curve, line) => {
        if (!pens.has(this.style(curve)))
          pens.set(this.style(curve), style(line, "stroke", "stroke-width", "stroke-dasharray"));
        return pens.get(this.style(curve));
      };
      const painted = this.axes.flatMap((each, k) => each.curves.map((curve) => ({ curve, y: ys[k] })));
      const seen = painted.map(({ curve, y }, k) => ({
        curve,
        y,
        points: curve.points,
        pen: penOf(curve, this.lines[k]),
      }));
      paintCurves(
        this.canvas,
        this.size,
        seen.filter(({ curve, points }) => points && !curve.hidden),
        x,
      );
    }
    put(this.blank, this.blankText?.(ys) ?? (ys.some((y) => y.ticks.length) ? "" : "no values"));
    this.read?.();
  }
  spot(x, y) {
    const scale = this.scales();
    this.ring.hidden = Number.isNaN(x + y);
    this.ring.style.left = `${(100 * (x - scale.x.low)) / (scale.x.high - scale.x.low)}%`;
    this.ring.style.top = `${100 * (1 - (y - scale.ys[0].low) / (scale.ys[0].high - scale.ys[0].low))}%`;
  }

  // -- files ---------------------------------------------------------------------------------------
  picture(title) {
    const curves = this.curves.filter((curve) => !curve.hidden && curve.kind !== "text"),
      rows = Math.ceil(curves.length / 3),
      [width, height, top, left, bottom] = [1000, 440 + 18 * rows, 44 + 18 * rows, 76, 46],
      inner = { width: width - left - 20 - 62 * (this.axes.length - 1), height: height - top - bottom },
      scales = this.scales(inner.width),
      { x, ys } = scales,
      paths = this.paths(scales, inner, { left, top });
    const stroke = (d, look) => tag("path", { fill: "none", d, ...look }),
      words = (a, b, text, more = {}) => tag("text", { x: a, y: b, ...more }, escapeText(text)),
      penOf = (element) => style(element, "stroke", "stroke-width", "stroke-dasharray", "stroke-linecap", "opacity"),
      colour = (name) => Object.values(style(document.documentElement, name))[0],
      grid = { stroke: colour("--grid") };
    const parts = [
      tag("rect", { width, height, fill: colour("--card") }),
      words(left, 24, title, { "font-weight": 600 }),
    ];
    for (const t of x.ticks) {
      const at = left + inner.width * t.at;
      parts.push(stroke(`M${at} ${top}v${inner.height}`, grid));
      parts.push(words(at, top + inner.height + 18, t.label, { "text-anchor": "middle" }));
    }
    ys.forEach((y, k) => {
      const at = k ? left + inner.width + 62 * k - 56 : left - 8,
        anchor = { "text-anchor": k ? "start" : "end" };
      for (const t of y.ticks) {
        const line = top + inner.height * (1 - t.at);
        parts.push(k ? "" : stroke(`M${left} ${line}h${inner.width}`, grid), words(at, line + 4, t.label, anchor));
      }
      parts.push(words(at, top - 6, `${this.shown[k].head.textContent} ${y.factor}`.trim(), anchor));
    });
    const marks = ["zero", "limit", "event", "pin"].map((name) => stroke(paths[name], penOf(this.marks[name])));
    const shades = ["outside", "span", "band"].map((name) =>
      tag("path", { d: paths[name], ...style(this.marks[name], "fill", "fill-opacity") }),
    );
    const lines = this.lines.map((line, k) => stroke(paths.curves[k], penOf(line)));
    curves.forEach((curve, k) => {
      const [column, line] = [left + (k % 3) * (inner.width / 3), 40 + 18 * Math.floor(k / 3)];
      parts.push(stroke(`M${column} ${line}h22`, penOf(this.lines[this.curves.indexOf(curve)])));
      parts.push(words(column + 28, line + 4, this.labelOf(curve)));
    });
    const clip = { x: left, y: top, ...inner, viewBox: `${left} ${top} ${inner.width} ${inner.height}` };
    parts.push(tag("svg", clip, [...shades, ...marks, ...lines].join("")));
    parts.push(words(width - 20, height - 8, `${this.over} ${x.factor}`, { "text-anchor": "end" }));
    const font = { "font-family": "system-ui, sans-serif", "font-size": 12, fill: colour("--ink") },
      frame = { xmlns: this.svg.namespaceURI, width, height, viewBox: `0 0 ${width} ${height}` };
    return tag("svg", { ...frame, ...font }, parts.join(""));
  }
  saveAs(kind, name, title) {
    if (kind === "SVG") save(new Blob([this.picture(title)], { type: "image/svg+xml" }), `${name}.svg`);
    else savePng(this.picture(title), `${name}.png`);
  }

  // -- pointer, fingers, keys ----------------------------------------------------------------------
  listen() {
    const { box, host } = this,
      fingers = new Map();
    let start = null, // where a zoom began, as a share of the width
      pan = null,
      mark = null,
      apart = 0;
    const share = (x) => {
      const frame = box.getBoundingClientRect();
      return Math.max(0, Math.min(1, (x - frame.left) / frame.width));
    };
    const at = (part) => host.view.from + part * (host.view.to - host.view.from);
    const unmark = (event) => {
      fingers.delete(event?.pointerId);
      mark?.remove();
      start = pan = mark = null;
    };
    box.addEventListener("pointerdown", (event) => {
      if (this.kind !== "time" || event.button > 1) return;
      box.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, event.clientX);
      const now = share(event.clientX);
      if (fingers.size === 2) apart = Math.max(8, Math.abs([...fingers.values()].reduce((a, b) => a - b)));
      else if (event.button || event.shiftKey) pan = { now, ...host.view };
      else if (event.pointerType !== "touch") start = now;
      host.seek(at(now), this, event);
      if (event.pointerType === "touch") return;
      event.preventDefault();
      box.focus({ preventScroll: true });
    });
    box.addEventListener("pointermove", (event) => {
      if (this.kind !== "time") return;
      if (fingers.has(event.pointerId)) fingers.set(event.pointerId, event.clientX);
      const now = share(event.clientX);
      if (fingers.size === 2) {
        const [a, b] = fingers.values(),
          width = Math.max(8, Math.abs(a - b));
        host.zoom(apart / width, at(share((a + b) / 2)));
        apart = width;
      } else if (pan) {
        const shift = (pan.now - now) * (pan.to - pan.from);
        host.look(pan.from + shift, pan.to + shift);
      } else {
        host.seek(at(now), this, event);
        if (start === null || Math.abs(now - start) * box.clientWidth < 5) return;
        mark ??= box.appendChild(make("span", { class: "marked", "aria-hidden": "true" }));
        mark.style.left = `${100 * Math.min(start, now)}%`;
        mark.style.width = `${100 * Math.abs(now - start)}%`;
      }
    });
    box.addEventListener("pointerup", (event) => {
      const now = at(share(event.clientX));
      if (mark) host.look(...[at(start), now].sort((a, b) => a - b));
      else if (start !== null) host.click(now, this, event);
      unmark(event);
    });
    box.addEventListener("pointercancel", unmark);
    // a finger that has left still reads: its place stays until another one is touched
    box.addEventListener("pointerleave", (event) => event.pointerType !== "touch" && host.rest());
    box.addEventListener("blur", () => host.rest());
    box.addEventListener("dblclick", () => host.home());
    const wheel = (event, deed) => {
      event.preventDefault();
      deed(event.deltaY > 0 ? 1.25 : 0.8);
    };
    box.addEventListener(
      "wheel",
      (event) => {
        const isMeant = host.takesWheel || event.ctrlKey || event.metaKey; // in a report a wheel alone scrolls the page
        if (this.kind === "time" && isMeant) wheel(event, (factor) => host.zoom(factor, at(share(event.clientX))));
      },
      { passive: false },
    );
    const axisAt = (event) => this.axes[event.target.closest("[data-axis]")?.dataset.axis];
    this.grid.addEventListener(
      "wheel",
      (event) => {
        const isMeant = axisAt(event) && (host.takesWheel || event.ctrlKey || event.metaKey);
        if (isMeant) wheel(event, (factor) => this.stretch(axisAt(event), factor));
      },
      { passive: false },
    );
    this.grid.addEventListener("dblclick", (event) => {
      if (!axisAt(event)) return;
      axisAt(event).range = null;
      host.draw([this]);
    });
    box.addEventListener("keydown", (event) => {
      if (event.altKey || event.ctrlKey || event.metaKey) return;
      const about = host.cursor ?? at(0.5),
        deeds = {
          PageUp: () => host.pan(-0.5),
          PageDown: () => host.pan(0.5),
          "+": () => host.zoom(0.5, about),
          "=": () => host.zoom(0.5, about),
          "-": () => host.zoom(2, about),
          "*": () => this.axes.forEach((each) => this.stretch(each, 0.8)),
          "/": () => this.axes.forEach((each) => this.stretch(each, 1.25)),
          0: () => host.home(),
          Escape: () => host.home(),
          ...host.keys(this, event),
        };
      if (!(event.key in deeds)) return;
      event.preventDefault();
      deeds[event.key]();
      host.tell(this);
    });
  }
  stretch(each, factor) {
    const range = this.range(each);
    if (!range) return;
    const middle = (range[0] + range[1]) / 2;
    each.range = range.map((end) => middle + (end - middle) * factor);
    this.host.draw([this]);
  }
}
