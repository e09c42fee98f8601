// One plot: curves over time on one to four axes, or over another signal.
/* global axis, all, make, put, readable, extremesPath, tickLabels, gridPaths, escapeText, tag, pen, paintCurves */
/* exported SignalPlot, MOST_AXES */

const WIDE = 4000,
  HIGH = 1000,
  COLOURS = 6,
  MOST_AXES = 4;

class SignalPlot {
  // desk: the page, which has view, runs and the actions of the plot
  constructor(desk, kind) {
    Object.assign(this, { desk, kind, axes: [{ curves: [], range: null }], across: null, fresh: false });
    const cursor = make("span", { class: "cursor", "aria-hidden": "true" }, make("span", { class: "when" }));
    this.svg = make("svg", { viewBox: `0 0 ${WIDE} ${HIGH}`, preserveAspectRatio: "none", "aria-hidden": "true" });
    this.canvas = make("canvas", { "aria-hidden": "true", hidden: "" }); // the lines, if there are many
    this.ring = make("span", { class: "spot", "aria-hidden": "true", hidden: "" });
    this.blank = make("span", { class: "blank" });
    const layers = [this.svg, this.canvas, this.blank, cursor, this.ring];
    this.box = make("div", { class: "box", tabindex: 0, role: "application" }, ...layers);
    this.box.setAttribute("aria-roledescription", "chart");
    this.title = make("button", {
      type: "button",
      class: "plot-title",
      title: "mark this plot: Enter in the tree adds here",
    });
    this.legend = make("span", { class: "legend" });
    this.tools = make("span", { class: "tools" });
    this.grid = make("div", { class: "axes" });
    this.figure = make("figure", { class: `plot ${kind}` }, make("figcaption", {}, this.title, this.legend), this.grid);
    this.title.addEventListener("click", () => desk.mark(this));
    for (const kindOfFile of ["PNG", "SVG", "CSV"])
      this.tools.append(this.button(kindOfFile, () => desk.export(this, kindOfFile)));
    this.tools.append(this.button("remove", () => desk.remove(this)));
  }

  button(words, action) {
    const button = make("button", { type: "button" }, words);
    button.addEventListener("click", action);
    return button;
  }

  get curves() {
    return this.axes.flatMap((each) => each.curves);
  }
  get name() {
    return `Plot ${this.desk.plots.indexOf(this) + 1}`;
  }

  // Curves of one unit share an axis; without a unit only the same signal of other runs does.
  add(pairs, place = null) {
    for (const [run, name] of pairs) {
      if (this.kind === "xy" && !this.across) {
        if (this.desk.runs[run].kinds[name] === "text") continue;
        this.across = { run, name };
        continue;
      }
      const { kinds, units } = this.desk.runs[run],
        kind = kinds[name];
      if (this.across && (kind === "text" || !(this.across.name in units))) continue;
      if (this.curves.some((c) => c.run === run && c.name === name)) continue;
      const unit = units[name] || "",
        used = new Set(this.curves.filter((c) => c.kind !== "text").map((c) => c.colour)),
        free = [...Array(used.size + 1).keys()].find((k) => !used.has(k));
      const colour = kind === "text" ? 0 : free,
        curve = { run, name, unit, kind, colour, hidden: false, data: null, value: null };
      (place === null ? this.axisFor(curve) : this.axes[place]).curves.push(curve);
    }
    this.build();
  }
  axisFor({ name, unit, kind }) {
    if (kind === "text") return this.axes[0];
    const suits = ({ curves }) => {
      const first = curves.find((c) => c.kind !== "text");
      return !first || (unit ? first.unit === unit : first.name === name);
    };
    const found = this.axes.find(suits);
    if (found || this.axes.length === MOST_AXES || this.kind === "xy") return found ?? this.axes.at(-1);
    this.axes.push({ curves: [], range: null });
    return this.axes.at(-1);
  }
  take(curve) {
    for (const each of this.axes) each.curves = each.curves.filter((c) => c !== curve);
    this.axes = this.axes.filter((each, k) => each.curves.length || (k === 0 && this.axes.length === 1));
    if (!this.axes.length) this.axes = [{ curves: [], range: null }];
    this.build();
  }
  // A curve goes to another axis of this plot, to a new one, or to a plot of its own.
  move(curve, to) {
    const target = to === "axis" ? null : this.axes[Number(to)];
    this.take(curve);
    if (to === "plot") return this.desk.addPlot("time", this).add([[curve.run, curve.name]]);
    if (target && this.axes.includes(target)) target.curves.push(curve);
    else this.axes.push({ curves: [curve], range: null });
    this.axes = this.axes.filter((each) => each.curves.length);
    this.build();
  }

  labelOf({ run, name }) {
    return this.desk.runs.length > 1 ? `${name} · ${this.desk.runs[run].short}` : name;
  }

  // Legend, axes and lines anew, after a change of the curves.
  build() {
    const { axes } = this,
      several = axes.length > 1;
    this.title.replaceChildren(this.name);
    const x = this.across && `${this.across.name} [${this.desk.runs[this.across.run].units[this.across.name] || "1"}]`;
    const entries = axes.flatMap((each, k) => each.curves.map((curve) => this.entry(curve, k, several)));
    this.legend.replaceChildren(...entries);
    this.shown = axes.map((each, k) => {
      const unit = [...new Set(each.curves.map((c) => c.unit).filter(Boolean))].join(", ");
      const ticks = make("div", { class: `y-ticks${k ? " right" : ""}`, "aria-hidden": "true" }),
        head = make("span", { class: "axis-unit" }, `${several ? `${k + 1}: ` : ""}${unit && `[${unit}]`}`),
        factor = make("span", { class: "factor" });
      const column = k ? 2 + k : 1;
      ticks.style.gridArea = `2 / ${column}`;
      head.style.gridArea = `1 / ${column}`;
      factor.style.gridArea = `3 / ${column}`;
      ticks.dataset.axis = k;
      return { ticks, head, factor };
    });
    this.xTicks = make("div", { class: "x-ticks", "aria-hidden": "true" });
    const over = this.kind === "xy" ? x || "first drop the signal of the x axis" : "time [s]";
    this.xLabel = make("div", { class: "x-label", "aria-hidden": "true" }, over);
    this.grid.replaceChildren(
      ...this.shown.flatMap(({ ticks, head, factor }) => [head, ticks, factor]),
      this.box,
      this.xTicks,
      this.xLabel,
      this.tools,
    );
    const words = this.curves.map((c) => this.labelOf(c)).join(", ") || "no signals";
    this.figure.setAttribute("aria-label", `${this.name}: ${words}`);
    const keys = "arrow keys move the cursor, plus and minus zoom, page up and down move along, 0 shows all";
    this.box.setAttribute("aria-label", `${this.name}: ${keys}`);
    this.marks = {
      grid: make("g", { class: "grid" }),
      zero: make("path", { class: "zero" }),
      pin: make("path", { class: "pin" }),
    };
    this.lines = this.curves.map((c) => make("path", { class: `line ${this.style(c)}` }));
    this.svg.replaceChildren(...Object.values(this.marks), ...this.lines);
    put(
      this.blank,
      this.curves.length
        ? ""
        : this.across || this.kind === "time"
          ? "Drop signals here."
          : "Drop the signal of the x axis, then others.",
    );
    for (const button of all("button", this.tools))
      button.disabled = !this.curves.length && button.textContent !== "remove";
    this.fresh = false;
    this.desk.changed();
  }
  style = ({ colour }) => `s${colour % COLOURS}${colour >= COLOURS ? " again" : ""}`;

  entry(curve, place, several) {
    const swatch = make("svg", { class: "swatch", viewBox: "0 0 22 8", "aria-hidden": "true" });
    swatch.append(make("path", { class: `line ${this.style(curve)}`, d: "M0 4h22" }));
    const name = make("button", {
      type: "button",
      class: "entry",
      "aria-pressed": String(!curve.hidden),
      title: "show or hide",
    });
    const isText = curve.kind === "text"; // which is read at the cursor, and has neither line nor axis
    name.append(...(isText ? [] : [swatch]), make("span", {}, this.labelOf(curve)));
    name.disabled = isText;
    name.addEventListener("click", () => {
      curve.hidden = !curve.hidden;
      name.setAttribute("aria-pressed", String(!curve.hidden));
      this.draw();
    });
    curve.cell = make("output", {});
    const parts = [name, curve.cell];
    if (this.kind === "time" && !isText) {
      const where = make("select", { class: "where", "aria-label": `Axis of ${this.labelOf(curve)}` });
      this.axes.forEach((_, k) => where.append(make("option", { value: k }, `axis ${k + 1}`)));
      if (this.axes.length < MOST_AXES && this.curves.length > 1)
        where.append(make("option", { value: "axis" }, "new axis"));
      where.append(make("option", { value: "plot" }, "new plot"));
      where.value = place;
      where.addEventListener("change", () => this.move(curve, where.value));
      where.classList.toggle("several", several);
      parts.push(where);
    }
    const away = this.button("×", () => this.take(curve));
    away.className = "away";
    away.setAttribute("aria-label", `Remove ${this.labelOf(curve)}`);
    const entry = make(
      "span",
      { class: "entry", draggable: "true", title: this.desk.about(curve) },
      ...parts,
      away,
    );
    entry.addEventListener("dragstart", (event) => {
      this.desk.dragged = { plot: this, curve };
      event.dataTransfer.setData("text/plain", JSON.stringify({ curves: [[curve.run, curve.name]] }));
    });
    return entry;
  }

  // -- drawing ---------------------------------------------------------------------------------------
  // Least and largest value of the curves of an axis that are in sight.
  range(each) {
    if (each.range) return each.range;
    const { from, to } = this.kind === "xy" ? { from: -Infinity, to: Infinity } : this.desk.view;
    let low = Infinity,
      high = -Infinity;
    for (const { data, hidden } of each.curves) {
      if (!data || hidden) continue;
      for (let k = 0; k < data.t.length; k++) {
        if (data.t[k + 1] < from || data.t[k - 1] > to) continue;
        if (data.low[k] < low) low = data.low[k];
        if (data.high[k] > high) high = data.high[k];
      }
    }
    if (low > high) return null;
    const margin = 0.06 * (high - low) || 0.1 * Math.abs(high) || 1;
    return [low - margin, high + margin];
  }

  // The ends of the x axis: those of the time in view, or of the signal across.
  ends() {
    if (this.kind === "time") return [this.desk.view.from, this.desk.view.to];
    const xs = this.curves.flatMap(({ data }) => (data?.x?.length ? [data.x] : []));
    let low = Infinity,
      high = -Infinity;
    for (const x of xs)
      for (const value of x) {
        if (value < low) low = value;
        if (value > high) high = value;
      }
    const margin = 0.03 * (high - low) || 1;
    return low > high ? [0, 1] : [low - margin, high + margin];
  }

  // Sizes are read before anything is drawn: between two plots the browser would lay out the page for each of them.
  measure() {
    this.size = { width: this.box.clientWidth, height: this.box.clientHeight };
  }

  scales() {
    if (!this.size) this.measure();
    const x = axis(...this.ends(), this.size.width < 420 ? 4 : 8);
    const ys = this.axes.map((each) => {
      const range = this.range(each);
      return range ? axis(...range, 5) : { low: 0, high: 1, ticks: [], factor: "" };
    });
    return { x, ys };
  }

  draw() {
    const { x, ys } = this.scales();
    this.xTicks.replaceChildren(...tickLabels(x.ticks, "left"));
    this.xLabel.dataset.factor = x.factor;
    ys.forEach((y, k) => {
      this.shown[k].ticks.replaceChildren(...tickLabels(y.ticks, "bottom"));
      put(this.shown[k].factor, y.factor);
    });
    this.marks.grid.replaceChildren(...gridPaths(x, ys[0], WIDE, HIGH));
    const [first] = ys,
      at = Math.round(HIGH * (1 - (0 - first.low) / (first.high - first.low)));
    this.marks.zero.setAttribute("d", first.low < 0 && first.high > 0 ? `M0 ${at}h${WIDE}` : "");
    const u = (t) => Math.round((WIDE * (t - x.low)) / (x.high - x.low));
    const { pin } = this.desk;
    this.marks.pin.setAttribute("d", pin === null || this.kind === "xy" ? "" : `M${u(pin)} 0v${HIGH}`);
    const isPainted = this.kind === "time" && this.desk.isPainted,
      painted = [],
      pens = new Map();
    let place = 0;
    this.axes.forEach((each, k) => {
      for (const curve of each.curves) {
        const line = this.lines[place++],
          style = this.style(curve);
        line.setAttribute("d", isPainted ? "" : this.path(curve, u, ys[k], HIGH));
        if (!isPainted || !curve.data || curve.hidden) continue;
        if (!pens.has(style)) pens.set(style, pen(line));
        painted.push({ data: curve.data, y: ys[k], pen: pens.get(style) });
      }
    });
    this.canvas.hidden = !isPainted;
    if (isPainted) paintCurves(this.canvas, this.size, painted, x);
    this.read();
  }

  path({ data, hidden }, u, y, height, top = 0) {
    if (!data || hidden) return "";
    const { t, x, low, high } = data;
    const v = (value) =>
      Math.round(top + height * (1 - Math.max(-9, Math.min(10, (value - y.low) / (y.high - y.low)))));
    const clip = (value) => Math.max(-9 * WIDE, Math.min(10 * WIDE, u(value)));
    const along = x ?? t;
    return extremesPath(
      t.length,
      (n) => clip(along[n]),
      (n) => (Number.isNaN(along[n]) ? NaN : v(low[n])),
      (n) => v(high[n]),
    );
  }

  // The values at the cursor: rows that are here are exact, others come from the server.
  read() {
    const { cursor, view, pin } = this.desk;
    const share = cursor === null ? 0 : (cursor - view.from) / (view.to - view.from);
    this.box.classList.toggle("cursor-away", cursor === null || share < 0 || share > 1);
    for (const curve of this.curves) put(curve.cell, this.words(curve, cursor, pin));
    this.ring.hidden = true;
    if (this.kind === "xy" && cursor !== null && this.curves[0]?.data) this.spot(cursor);
  }

  words({ run, data, value, text, kind, lost, pinned }, cursor, pin) {
    if (lost) return "removed";
    if (cursor === null) return kind === "text" ? "text, at the cursor" : "";
    if (this.isOver(run, cursor)) return "ended";
    if (kind && text?.at === cursor && (kind === "text" || pin === null))
      return kind === "text" ? `“${text.text ?? ""}”` : (text.text ?? "");
    if (value?.at === cursor) {
      const more = pin === null || pinned === undefined ? "" : ` (Δ ${readable(value.value - pinned)})`;
      return readable(value.value) + more;
    }
    const k = data ? lastUpTo(data.t, cursor) : -1;
    if (k < 0) return "";
    return data.isRow ? readable(data.low[k]) : `${readable(data.low[k])} … ${readable(data.high[k])}`;
  }

  isOver(run, cursor) {
    const { from, to } = this.desk.runs[run];
    return cursor > to + 1e-9 * (to - from);
  }

  spot(cursor) {
    if (this.isOver(this.curves[0].run, cursor)) return;
    const { t, x, low } = this.curves[0].data,
      k = lastUpTo(t, cursor),
      scale = this.scales();
    if (k < 0 || Number.isNaN(x[k] + low[k])) return;
    this.ring.hidden = false;
    this.ring.style.left = `${(100 * (x[k] - scale.x.low)) / (scale.x.high - scale.x.low)}%`;
    this.ring.style.top = `${100 * (1 - (low[k] - scale.ys[0].low) / (scale.ys[0].high - scale.ys[0].low))}%`;
  }

  // -- a picture for a file ----------------------------------------------------------------------------
  picture() {
    const { x, ys } = this.scales();
    const rows = Math.ceil(this.curves.filter((c) => c.kind !== "text").length / 3);
    const [width, height, top, right, bottom] = [1000, 440 + 18 * rows, 44 + 18 * rows, 20 + 62 * (ys.length - 1), 44],
      left = 72;
    const [wide, high] = [width - left - right, height - top - bottom];
    const look = getComputedStyle(document.documentElement),
      colour = (name) => look.getPropertyValue(name).trim();
    const stroke = (d, pens) => tag("path", { fill: "none", d, ...pens });
    const words = (a, b, text, more = {}) => tag("text", { x: a, y: b, ...more }, escapeText(text));
    const u = (value) => Math.round((left + (wide * (value - x.low)) / (x.high - x.low)) * 10) / 10;
    const grid = { stroke: colour("--grid") };
    const parts = [
      tag("rect", { width, height, fill: colour("--card") }),
      words(left, 24, this.name, { "font-weight": 600 }),
    ];
    for (const t of x.ticks) {
      const at = left + (wide * t.at) / 100;
      parts.push(
        stroke(`M${at} ${top}v${high}`, grid),
        words(at, top + high + 18, t.label, { "text-anchor": "middle" }),
      );
    }
    ys.forEach((y, k) => {
      const at = k ? left + wide + 62 * k - 56 : left - 8,
        anchor = { "text-anchor": k ? "start" : "end" };
      for (const t of y.ticks) {
        const level = top + high * (1 - t.at / 100);
        parts.push(k ? "" : stroke(`M${left} ${level}h${wide}`, grid), words(at, level + 4, t.label, anchor));
      }
      parts.push(words(at, top - 6, `${this.shown[k].head.textContent} ${y.factor}`.trim(), anchor));
    });
    const paths = [];
    let place = 0;
    this.axes.forEach((each, k) => {
      for (const curve of each.curves.filter((c) => c.kind !== "text")) {
        const pens = pen(this.lines[this.curves.indexOf(curve)]),
          column = (place % 3) * (wide / 3) + left,
          line = 40 + 18 * Math.floor(place / 3);
        paths.push(stroke(this.path(curve, u, ys[k], high, top), pens));
        parts.push(stroke(`M${column} ${line}h22`, pens), words(column + 28, line + 4, this.labelOf(curve)));
        place++;
      }
    });
    parts.push(
      tag(
        "svg",
        { x: left, y: top, width: wide, height: high, viewBox: `${left} ${top} ${wide} ${high}` },
        paths.join(""),
      ),
      words(width - right, height - 8, `${this.xLabel.textContent} ${x.factor}`, { "text-anchor": "end" }),
    );
    const font = { "font-family": "system-ui, sans-serif", "font-size": 12, fill: colour("--ink") };
    const frame = { xmlns: this.svg.namespaceURI, width, height, viewBox: `0 0 ${width} ${height}` };
    return tag("svg", { ...frame, ...font }, parts.join(""));
  }
}

// The place of the last time up to a time, −1 before the first.
function lastUpTo(times, time) {
  let low = 0,
    high = times.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}
