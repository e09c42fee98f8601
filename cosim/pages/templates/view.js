// The signal browser: plots over one time, points from the server for what is in sight, layouts; of a
// running command also its rows as they come.
/* global one, all, make, button, put, readable, post, request, safeName, lastUpTo, Linked, Chart, SignalTree,
   MOST_AXES, COLOURS */
/* exported startView */

// One plot: curves over time on one to four axes, or over another signal.
class SignalPlot extends Chart {
  constructor(host, kind) {
    const statistics = make("div", { class: "scroll statistics", hidden: "" });
    const title = make("button", {
        type: "button",
        class: "plot-title",
        title: "select this plot: Enter in the tree adds signals here",
      }),
      figure = make("figure", { class: `plot ${kind}` });
    super(host, figure, { kind, across: null, isFresh: false, title, statistics, isLog: kind === "spectrum" });
    figure.append(make("figcaption", {}, title, this.legend), this.grid, statistics);
    if (kind === "spectrum") this.over = "frequency [Hz]";
    title.addEventListener("click", () => host.choose(this));
    for (const kindOfFile of ["PNG", "SVG", "CSV"])
      this.tools.append(button(kindOfFile, () => host.export(this, kindOfFile)));
    this.tools.append(button("remove", () => host.remove(this)));
  }
  get name() {
    return `Plot ${this.host.charts.indexOf(this) + 1}`;
  }
  labelOf({ run, name }) {
    return this.host.runs.length > 1 ? `${name} · ${this.host.runs[run].short}` : name;
  }
  headOf({ curves }, k) {
    const unit = [...new Set(curves.map((c) => c.unit).filter(Boolean))].join(", ");
    const shown = this.kind === "spectrum" ? `dB, ${unit ? `(${unit})²` : "1"}/Hz` : unit;
    return `${this.axes.length > 1 ? `${k + 1}: ` : ""}${shown && `[${shown}]`}`;
  }
  style = ({ colour }) => `s${colour % COLOURS}${colour >= COLOURS ? " again" : ""}`;

  curveOf(run, name, more = {}) {
    const { units, kinds } = this.host.runs[run],
      fresh = { colour: 0, hidden: false, points: null, value: null };
    return { run, name, unit: units[name] || "", kind: kinds[name], ...fresh, ...more };
  }
  // Curves of one unit share an axis; without a unit only the same signal of other runs does.
  add(pairs, place = null) {
    for (const [run, name] of pairs) {
      const { kinds, units } = this.host.runs[run],
        isText = kinds[name] === "text";
      if (this.kind === "spectrum" && isText) continue;
      if (this.kind === "xy" && !this.across) {
        if (!isText) this.across = { run, name };
        continue;
      }
      if (this.across && (isText || !(this.across.name in units))) continue;
      if (this.curves.some((c) => c.run === run && c.name === name)) continue;
      const used = new Set(this.curves.filter((c) => c.kind !== "text").map((c) => c.colour)),
        isAlone = this.curves.every((c) => c.name === name), // one signal of several runs: a colour for each run
        choices = [...(isAlone && this.host.runs.length > 1 ? [run] : []), ...Array(used.size + 1).keys()],
        free = choices.find((k) => !used.has(k)),
        curve = this.curveOf(run, name, { colour: isText ? 0 : free });
      (place === null ? this.axisFor(curve) : this.axes[place]).curves.push(curve);
    }
    this.build();
  }
  axisFor({ name, unit, kind }) {
    if (kind === "text") return this.axes[0];
    const found = this.axes.find(({ curves }) => {
      const first = curves.find((c) => c.kind !== "text");
      return !first || (unit ? first.unit === unit : first.name === name);
    });
    if (found || this.axes.length === MOST_AXES || this.kind === "xy") return found ?? this.axes.at(-1);
    this.axes.push({ curves: [], range: null });
    return this.axes.at(-1);
  }
  take(curve) {
    for (const each of this.axes) each.curves = each.curves.filter((c) => c !== curve);
    this.axes = this.axes.filter((each) => each.curves.length);
    if (!this.axes.length) this.axes = [{ curves: [], range: null }];
    this.build();
  }
  // A curve goes to another axis of this plot, to a new one, or to a plot of its own.
  move(curve, to) {
    const target = to === "axis" ? null : this.axes[Number(to)];
    this.take(curve);
    if (to === "plot") return this.host.addPlot("time", this).add([[curve.run, curve.name]]);
    if (target && this.axes.includes(target)) target.curves.push(curve);
    else this.axes.push({ curves: [curve], range: null });
    this.axes = this.axes.filter((each) => each.curves.length);
    this.build();
  }

  build() {
    const { across } = this;
    put(this.title, this.name);
    if (this.kind === "xy")
      this.over = across
        ? `${across.name} [${this.host.runs[across.run].units[across.name] || "1"}]`
        : "drop the signal of the x axis first";
    super.build();
    const words = this.curves.map((c) => this.labelOf(c)).join(", ") || "no signals";
    this.figure.setAttribute("aria-label", `${this.name}: ${words}`);
    const keys = "arrow keys move the cursor, plus and minus zoom, page up and down shift the time range, 0 shows all";
    this.box.setAttribute("aria-label", `${this.name}: ${keys}`);
    for (const each of all("button", this.tools)) each.disabled = !this.curves.length && each.textContent !== "remove";
    this.isFresh = false;
    this.summarize();
    this.host.changed();
  }
  entry(curve, place) {
    const isText = curve.kind === "text", // which is read at the cursor, and has neither line nor axis
      label = this.labelOf(curve);
    const name = button("", () => {}, { class: "entry", "aria-pressed": String(!curve.hidden), title: "show or hide" });
    name.addEventListener("click", () => {
      curve.hidden = !curve.hidden;
      name.setAttribute("aria-pressed", String(!curve.hidden));
      this.host.draw([this]);
    });
    name.disabled = isText;
    const swatch = make("svg", { class: "swatch", viewBox: "0 0 22 8", "aria-hidden": "true" });
    swatch.append(make("path", { class: `line ${this.style(curve)}`, d: "M0 4h22" }));
    name.append(...(isText ? [] : [swatch]), make("span", {}, label));
    curve.cell = make("output");
    const parts = [name, curve.cell];
    if (this.kind === "time" && !isText) {
      const where = make("select", { class: "where", "aria-label": `Axis of ${label}` }),
        choices = this.axes.map((_, k) => [k, `axis ${k + 1}`]);
      if (this.axes.length < MOST_AXES && this.curves.length > 1) choices.push(["axis", "new axis"]);
      choices.push(["plot", "new plot"]);
      where.append(...choices.map(([value, words]) => make("option", { value }, words)));
      where.value = place;
      where.addEventListener("change", () => this.move(curve, where.value));
      parts.push(where);
    }
    const away = button("×", () => this.take(curve), { class: "away", "aria-label": `Remove ${label}` });
    const entry = make("span", { class: "entry", draggable: "true", title: this.host.about(curve) }, ...parts, away);
    entry.addEventListener("dragstart", (event) => {
      this.host.dragged = { plot: this, curve };
      event.dataTransfer.setData("text/plain", JSON.stringify({ curves: [[curve.run, curve.name]] }));
    });
    return entry;
  }
  blankText() {
    if (this.curves.length) return "";
    return this.across || this.kind !== "xy" ? "Drop signals here." : "Drop the signal of the x axis, then others.";
  }
  // The ends of the x axis: those of the time in view, or of the signal across.
  ends() {
    if (this.kind === "time") return super.ends();
    let [low, high] = [Infinity, -Infinity];
    for (const { points } of this.curves)
      for (const value of points?.over ?? points?.x ?? []) [low, high] = [Math.min(low, value), Math.max(high, value)];
    const margin = this.isLog ? 0 : 0.03 * (high - low) || 1;
    return low > high ? [0, 1] : [low - margin, high + margin];
  }

  // The values at the cursor: rows that are here are exact, others come from the server; without a cursor the latest
  // ones of a running command.
  read() {
    const { cursor, view } = this.host,
      share = cursor === null ? -1 : (cursor - view.from) / (view.to - view.from);
    this.box.classList.toggle("cursor-away", share < 0 || share > 1);
    const from = this.host.marks.length === 1 ? ` (Δ ${readable(cursor - this.host.marks[0])} s)` : "";
    put(this.when, cursor === null ? "" : `${readable(cursor)} s${from}`);
    for (const curve of this.curves) put(curve.cell, this.words(curve, cursor));
    this.ring.hidden = true;
    if (this.kind !== "xy" || cursor === null || !this.curves[0]?.points || this.isOver(this.curves[0].run, cursor))
      return;
    const { x, over, low } = this.curves[0].points,
      k = lastUpTo(x, cursor);
    if (k >= 0) this.spot(over[k], low[k]);
  }
  words(curve, cursor) {
    const { points, kind, text } = curve,
      isText = kind === "text";
    if (this.kind === "spectrum") return this.peak(points);
    if (cursor === null && isText) return "text, at the cursor";
    if (cursor === null) return this.host.isLive && points?.low.length ? readable(points.low.at(-1)) : "";
    if (this.isOver(curve.run, cursor)) return "ended";
    if (isText) return text?.at === cursor ? `“${text.text ?? ""}”` : "";
    if (kind && text?.at === cursor && this.host.marks.length !== 1) return text.text ?? "";
    return this.number(curve, cursor);
  }
  // The highest point of a spectrum.
  peak(points) {
    if (!points) return "";
    if (!points.x.length) return "too few rows";
    const k = points.low.reduce((best, value, place) => (value > points.low[best] ? place : best), 0);
    return `peak ${readable(points.low[k])} dB at ${readable(10 ** points.x[k])} Hz`;
  }
  // The statistics of each curve between the marks.
  async summarize() {
    const { marks } = this.host,
      curves = this.curves.filter((c) => c.kind !== "text");
    this.statistics.hidden = marks.length < 2 || this.kind !== "time" || !curves.length;
    if (this.statistics.hidden) return;
    const [from, to] = [...marks].sort((a, b) => a - b),
      asked = { from, to, curves: curves.map((c) => [c.run, c.name]) },
      answer = await request("statistics", asked).catch((error) => this.host.warn(error.message));
    if (!answer) return;
    const numbers = new Float64Array(await answer.arrayBuffer()),
      heads = ["min", "max", "mean", "RMS", "σ"],
      cells = (k) => heads.map((_, n) => make("td", { class: "num" }, readable(numbers[heads.length * k + n])));
    this.statistics.replaceChildren(
      make(
        "table",
        {},
        make("caption", {}, `${readable(from)} … ${readable(to)} s, Δt = ${readable(to - from)} s`),
        make(
          "thead",
          {},
          make(
            "tr",
            {},
            ...["signal", ...heads].map((head, k) => make("th", { scope: "col", class: k ? "num" : null }, head)),
          ),
        ),
        make(
          "tbody",
          {},
          ...curves.map((c, k) => make("tr", {}, make("th", { scope: "row" }, this.labelOf(c)), ...cells(k))),
        ),
      ),
    );
  }
  number({ points, value, pinned }, cursor) {
    if (value?.at === cursor) {
      const isPinned = this.host.marks.length === 1 && pinned !== undefined;
      return readable(value.value) + (isPinned ? ` (Δ ${readable(value.value - pinned)})` : "");
    }
    const k = points ? lastUpTo(points.x, cursor) : -1;
    if (k < 0) return "";
    return points.isRow ? readable(points.low[k]) : `${readable(points.low[k])} … ${readable(points.high[k])}`;
  }
  isOver(run, cursor) {
    const { from, to } = this.host.runs[run];
    return cursor > to + 1e-9 * (to - from);
  }
}

const MOST_DROPPED = 24, // signals of a group that are added at once
  LATE = 150, // [ms] until many points are drawn as they are here, if the answer has not come
  QUICK = 2000, // points; more are painted as pixels, once, when the answer comes
  DENSE = 24, // curves; more are painted as pixels, of half as many columns
  IN_PLOT = 6, // signals of a plot at the start of a running command
  MOST_JUDGED = 6; // plots at the start, of signals with criteria
const paper = matchMedia("print");

// All plots of the page, with one time and one cursor.
class Desk extends Linked {
  constructor(about, isLive) {
    super(0, 1);
    Object.assign(this, {
      isLive,
      takesWheel: true,
      marks: [], // one or two times [s]
      dragged: null,
      active: null,
      changes: [],
      follows: "so far",
      told: [...about.notes],
      isBusy: false,
      isAgain: false,
      isWaiting: false,
      isReading: false,
      late: 0,
    });
    this.runs = about.runs.map((run) => {
      const { numbers, units, texts } = run,
        [own, kinds] = [Object.create(null), Object.create(null)],
        short = run.label.split(" (")[0],
        isOne = about.runs.filter(({ label }) => label.split(" (")[0] === short).length === 1;
      numbers.forEach((name, k) => (own[name] = units[k]));
      for (const name of texts) {
        kinds[name] = name in own ? "whole" : "text"; // integers that doubles may round are numbers and texts
        own[name] ??= "";
      }
      const names = [...new Set([...numbers, ...texts])];
      return { ...run, short: isOne ? short : run.label, names, units: own, kinds };
    });
    this.measureTime();
    this.view = { ...this.whole };
    this.watcher = new IntersectionObserver(
      (entries) => {
        for (const { target, isIntersecting } of entries)
          for (const plot of this.charts) if (plot.figure === target) plot.isNear = isIntersecting;
        this.schedule();
      },
      { rootMargin: "300px" },
    );
    this.resized = new ResizeObserver(() => this.schedule()); // a plot is pulled to another height
    this.warn("");
  }
  tell(words) {
    if (typeof words === "string") return put(one("#told"), words);
    if (this.cursor === null) return;
    const values = words.curves.map((c) => `${c.name} ${c.cell.textContent}`);
    put(one("#told"), `${readable(this.cursor)} s: ${values.join(", ")}`);
  }
  warn(words) {
    if (words && !this.told.includes(words)) this.told.push(words);
    one("#notes").hidden = !this.told.length;
    put(one("#notes"), this.told.join(" · "));
  }
  measureTime() {
    const from = Math.min(...this.runs.map((r) => r.from)),
      to = Math.max(...this.runs.map((r) => r.to));
    this.whole = { from, to: to > from ? to : from + 1 };
    this.least = 1e-9 * (this.whole.to - this.whole.from);
  }

  // -- plots --------------------------------------------------------------------------------------
  addPlot(kind, after = null) {
    const plot = new SignalPlot(this, kind);
    this.charts.splice(after ? this.charts.indexOf(after) + 1 : this.charts.length, 0, plot);
    one("#plots").insertBefore(plot.figure, after ? after.figure.nextSibling : null);
    this.watcher.observe(plot.figure);
    this.resized.observe(plot.grid);
    this.accept(plot.figure, (curves, event) =>
      this.drop(plot, curves, event.target.closest?.("[data-axis]")?.dataset.axis),
    );
    this.choose(plot);
    for (const each of this.charts) each.build();
    return plot;
  }
  remove(plot) {
    const before = this.extent;
    plot.figure.remove();
    this.charts = this.charts.filter((each) => each !== plot);
    if (!this.charts.length) this.addPlot("time");
    if (this.active === plot) this.choose(this.charts[0]);
    for (const each of this.charts) each.build();
    this.keepWhole(before);
  }
  // Mark a plot.
  choose(plot) {
    this.active = plot;
    for (const each of this.charts) {
      each.figure.classList.toggle("active", each === plot && this.charts.length > 1);
      each.title.setAttribute("aria-pressed", String(each === plot));
    }
  }
  add(curves, plot, place = null) {
    const some = curves.slice(0, MOST_DROPPED),
      before = this.extent,
      rest = curves.length - some.length;
    plot.add(some, place);
    this.keepWhole(before);
    this.choose(plot);
    const what = some.length === 1 ? some[0][1] : `${some.length} signals`;
    this.tell(`${what} in ${plot.name}${rest ? `; ${rest} more left out` : ""}`);
  }
  drop(plot, curves, place) {
    const { dragged } = this;
    if (dragged?.plot === plot && place !== undefined) return plot.move(dragged.curve, place);
    if (dragged && dragged.plot !== plot) dragged.plot.take(dragged.curve);
    if (dragged?.plot !== plot) this.add(curves, plot, place === undefined ? null : Number(place));
  }
  accept(element, take) {
    const mark = (isOver) => element.classList.toggle("over", isOver);
    element.addEventListener("dragover", (event) => {
      event.preventDefault();
      mark(true);
    });
    element.addEventListener("dragleave", () => mark(false));
    element.addEventListener("drop", (event) => {
      event.preventDefault();
      mark(false);
      try {
        const { curves } = JSON.parse(event.dataTransfer.getData("text/plain"));
        if (curves.length) take(curves, event);
      } catch {
        this.tell("This is not a signal.");
      }
    });
  }
  arrange(columns) {
    one("#columns").value = columns;
    one("#plots").style.gridTemplateColumns = columns > 1 ? `repeat(${columns}, minmax(0, 1fr))` : "";
    this.looked();
  }
  // All boxes have one width, so that one time is at one place.
  changed() {
    const right = Math.max(1, ...this.charts.map((plot) => plot.axes.length)) - 1;
    one("#plots").style.setProperty("--right", right ? `repeat(${right}, 66px)` : "");
    this.schedule();
  }
  get curves() {
    return this.charts.filter(({ kind }) => kind === "time").flatMap((plot) => plot.curves);
  }
  get isDense() {
    return !paper.matches && this.curves.length > DENSE;
  }
  // A browser strokes paths of many points in tenths of a second.
  get isPainted() {
    const points = this.curves.reduce((sum, curve) => sum + (curve.points?.x.length ?? 0), 0);
    return this.isDense || (!paper.matches && points > QUICK);
  }
  // The run of a curve.
  about({ run, name }) {
    const { label, kinds } = this.runs[run];
    return kinds[name] === "text" ? `${label}\nTexts are not drawn; the cursor shows them.` : label;
  }

  // -- view and cursor ------------------------------------------------------------------------------
  looked() {
    one("#from").value = +this.view.from.toPrecision(9);
    one("#to").value = +this.view.to.toPrecision(9);
    for (const plot of this.charts) plot.isFresh = false;
    this.mark(one("#charts"));
    this.schedule();
  }
  look(from, to, follows = "") {
    this.follows = follows;
    if (this.isLive) one("#window").value = follows;
    super.look(from, to);
  }
  home() {
    for (const each of this.charts.flatMap((plot) => plot.axes)) each.range = null;
    this.look(this.extent.from, this.extent.to, "so far");
  }
  // The time of the runs that are drawn: a short run beside a long one that is not drawn keeps its width.
  get extent() {
    const drawn = new Set(this.charts.flatMap((plot) => plot.curves.map((c) => c.run))),
      some = [...drawn].map((run) => this.runs[run]),
      from = Math.min(...some.map((r) => r.from)),
      to = Math.max(...some.map((r) => r.to));
    return to > from ? { from, to } : { ...this.whole };
  }
  keepWhole(before) {
    const isNear = (a, b) => Math.abs(a - b) <= 1e-9 * (before.to - before.from);
    if (isNear(this.view.from, before.from) && isNear(this.view.to, before.to)) this.home(); // it was not zoomed
  }
  // New rows of a run that grows: the page shows all of them, or the last seconds, unless the user has zoomed.
  grow(spans, end) {
    const wasWhole = this.isWhole;
    let isNew = false;
    spans.forEach(([rows, from, to], k) => {
      isNew ||= rows !== this.runs[k].rows;
      Object.assign(this.runs[k], { rows, from, to });
    });
    if (!isNew) return;
    this.measureTime();
    if (this.follows || wasWhole) this.follow(this.follows || "so far", end);
    else this.looked();
  }
  follow(what, end) {
    this.measureTime();
    if (what === "all") this.whole.to = Math.max(this.whole.to, end);
    const { from, to } = what === "so far" ? this.extent : this.whole;
    if (what) this.look(Number(what) ? to - Number(what) : from, to, what);
  }
  seek(time) {
    this.cursor = time;
    one("#charts").classList.toggle("reading", time !== null);
    this.mark(one("#charts"));
    for (const plot of this.charts) plot.read();
    this.fetchValues();
  }
  rest() {
    this.seek(null);
  }
  // The first click marks a time, the second one an interval, the third one removes the marks.
  click(time) {
    this.marks = this.marks.length < 2 ? [...this.marks, time] : [];
    for (const curve of this.charts.flatMap((p) => p.curves))
      curve.pinned = this.marks.length === 1 && curve.value ? curve.value.value : undefined;
    for (const plot of this.charts) plot.summarize();
    this.schedule();
  }
  keys(plot, event) {
    const { from, to } = this.view,
      at = this.cursor ?? (from + to) / 2,
      pixel = ((event.shiftKey ? 20 : 1) * (to - from)) / Math.max(1, plot.box.clientWidth);
    return {
      ArrowLeft: () => this.seek(Math.max(from, at - pixel)),
      ArrowRight: () => this.seek(Math.min(to, at + pixel)),
      Home: () => this.seek(from),
      End: () => this.seek(to),
      m: () => this.click(at),
      Delete: () => this.remove(plot),
    };
  }

  // -- points and values from the server --------------------------------------------------------------
  get near() {
    return this.charts.filter((plot) => plot.isNear);
  }
  schedule() {
    document.documentElement.dataset.view = "asked";
    queueMicrotask(() => this.fetchPoints());
    if (this.isWaiting) return;
    this.isWaiting = true;
    requestAnimationFrame(() => {
      this.isWaiting = false;
      clearTimeout(this.late);
      if (this.isBusy && this.isPainted) this.late = setTimeout(() => this.draw(this.near), LATE);
      else this.draw(this.near); // what is here, until more is
    });
  }
  async fetchPoints() {
    if (this.isBusy) {
      this.isAgain = true;
      return;
    }
    const isDone = () => this.charts.every((plot) => plot.isNear !== undefined),
      stale = () => this.near.filter((plot) => !plot.isFresh && plot.curves.length),
      plots = stale();
    if (!plots.length) {
      if (isDone()) document.documentElement.dataset.view = "drawn";
      return;
    }
    document.documentElement.dataset.view = "fetching";
    Object.assign(this, { isBusy: true, isAgain: false });
    for (const plot of plots) plot.isFresh = true;
    try {
      const shown = (kind) =>
        plots
          .filter((p) => p.kind === kind)
          .flatMap((plot) => plot.curves.filter((c) => c.kind !== "text").map((c) => [plot, c]));
      const width = Math.max(200, Math.round((plots[0].box.clientWidth || 800) / (this.isDense ? 2 : 1))),
        range = { ...this.view },
        planes = shown("xy"),
        across = planes.map(([plot, c]) => [c.run, plot.across.name]);
      const asked = [
        ["points", { ...range, width }, shown("time")],
        ["plane", { ...range, width: 8000, across }, planes],
        ["spectrum", range, shown("spectrum")],
      ];
      for (const [path, about, pairs] of asked) {
        const curves = pairs.map(([, curve]) => curve);
        await this.fill(path, about, curves);
      }
    } catch (error) {
      const isGone = error.message === "Failed to fetch";
      this.warn(isGone ? "The command does not respond. The data received so far remain on this page." : error.message);
    } finally {
      this.isBusy = false;
    }
    clearTimeout(this.late);
    this.draw(plots);
    if (this.isAgain || stale().length) this.fetchPoints();
    else if (isDone()) document.documentElement.dataset.view = "drawn";
  }
  async fill(path, asked, curves) {
    if (!curves.length) return;
    const answer = await request(path, { ...asked, curves: curves.map((c) => [c.run, c.name]) }),
      numbers = new Float64Array(await answer.arrayBuffer());
    let at = 0;
    const part = (length) => numbers.subarray(at, (at += length));
    for (const curve of curves) {
      const [count, step] = part(2),
        [x, first, second] = [part(count), part(count), part(count)],
        isRow = step === 1;
      curve.points =
        path === "plane"
          ? { x, over: first, low: second, high: second, isRow }
          : { x, low: first, high: second, isRow };
    }
  }
  async fetchValues() {
    if (this.isReading || this.cursor === null) return;
    const at = this.cursor,
      shown = this.near.flatMap((plot) => plot.curves),
      curves = shown.filter(({ kind }) => kind !== "text"),
      exact = shown.filter(({ kind }) => kind);
    if (!shown.length) return;
    this.isReading = true;
    const of = (some) => ({ at, curves: some.map((c) => [c.run, c.name]) });
    try {
      const [answer, texts] = await Promise.all([
        curves.length ? request("values", of(curves)) : null,
        exact.length ? post("texts", of(exact)) : [],
      ]);
      const numbers = new Float64Array(answer ? await answer.arrayBuffer() : 0);
      curves.forEach((curve, k) => (curve.value = { at, value: numbers[2 * k + 1] }));
      exact.forEach((curve, k) => (curve.text = { at, text: texts[k] }));
    } catch {
      return; // the points tell
    } finally {
      this.isReading = false;
    }
    for (const plot of this.charts) plot.read();
    if (this.cursor !== at) this.fetchValues();
  }
  async export(plot, kind) {
    const name = safeName(plot.curves.map((c) => c.name).join(" ") || plot.name);
    if (kind === "CSV") {
      const curves = plot.curves.map((c) => [c.run, c.name]);
      if (plot.across) curves.unshift([plot.across.run, plot.across.name]);
      const of = JSON.stringify({ ...this.view, curves });
      make("a", { href: `export.csv?${new URLSearchParams({ of })}`, download: `${name}.csv` }).click();
      return;
    }
    const curves = plot.curves.filter((c) => c.kind !== "text"),
      before = curves.map((c) => c.points); // a narrow page has fewer columns than the picture
    if (plot.kind === "time") await this.fill("points", { ...this.view, width: 1600 }, curves).catch(() => {});
    plot.saveAs(kind, name, plot.name);
    curves.forEach((curve, k) => (curve.points = before[k]));
  }

  // -- layouts --------------------------------------------------------------------------------------------
  layout() {
    const named = ({ run, name, ...more }) => ({ run: this.runs[run].name, name, ...more }),
      curveOf = ({ run, name, colour, hidden }) => named({ run, name, colour, hidden });
    const plots = this.charts.map(({ kind, across, axes, grid }) => ({
      kind,
      height: parseInt(grid.style.height) || null,
      across: across && named(across),
      axes: axes.map(({ range, curves }) => ({ range, curves: curves.map(curveOf) })),
    }));
    return { view: { ...this.view }, columns: Number(one("#columns").value), plots };
  }
  // A run of a layout that is not here is the only one, if there is only one in both.
  open(content) {
    const { plots = [] } = content,
      names = new Set(plots.flatMap((p) => p.axes.flatMap((a) => a.curves.map((c) => c.run)))),
      isOnly = names.size === 1 && this.runs.length === 1,
      find = (label) => (isOnly ? 0 : this.runs.findIndex((run) => run.name === label)),
      missing = [];
    const known = (c) => {
      const run = find(c.run);
      if (run >= 0 && c.name in this.runs[run].units) return [{ ...c, run }];
      missing.push(`${c.name} of ${c.run}`);
      return [];
    };
    for (const plot of this.charts) plot.figure.remove();
    this.charts = [];
    this.arrange(content.columns ?? 1);
    for (const { kind, across, axes, height } of plots) {
      const plot = this.addPlot(["xy", "spectrum"].includes(kind) ? kind : "time");
      plot.across = across ? (known(across)[0] ?? null) : null;
      const isReady = plot.kind !== "xy" || plot.across;
      plot.axes = axes.map(({ range, curves }) => ({
        range: Array.isArray(range) ? range.map(Number) : null,
        curves: (isReady ? curves.flatMap(known) : []).map((c) =>
          plot.curveOf(c.run, c.name, { colour: Number(c.colour) || 0, hidden: Boolean(c.hidden) }),
        ),
      }));
      if (!plot.axes.length) plot.axes = [{ curves: [], range: null }];
      if (height) plot.grid.style.height = `${height}px`;
      plot.build();
    }
    if (!this.charts.length) this.addPlot("time");
    const { from, to } = content.view ?? this.extent;
    this.look(Number(from), Number(to));
    if (missing.length)
      this.warn(
        `Omitted, because these runs lack them: ${missing.slice(0, 5).join(", ")}${missing.length > 5 ? ", …" : ""}`,
      );
  }
  // The signals of criteria, each with its target, in all runs that have them.
  plotJudged() {
    const pairs = new Map();
    this.runs.forEach(({ judged, units }, run) => {
      for (const [name, target] of judged) {
        const curves = [[run, name], ...(target ? [[run, target]] : [])].filter(([, each]) => each in units);
        const known = pairs.get(name) ?? [];
        pairs.set(name, [...known, ...curves.filter(([, each]) => !known.some((c) => c[0] === run && c[1] === each))]);
      }
    });
    for (const curves of [...pairs.values()].slice(0, MOST_JUDGED))
      if (curves.length) this.add(curves.slice(0, MOST_DROPPED), this.addPlot("time"));
    if (!this.charts.length) this.addPlot("time");
    this.choose(this.charts[0]);
  }
  // The first signals of a running command, a plot for each unit of a component.
  plotFirst(inputs) {
    const groups = new Map(),
      { names, units } = this.runs[0],
      first = names.slice(0, MOST_DROPPED); // what is set comes last
    for (const name of [...first.filter((n) => !inputs.has(n)), ...first.filter((n) => inputs.has(n))]) {
      const key = units[name] ? `${name.split(".")[0]} ${units[name]}` : name;
      groups.set(key, [...(groups.get(key) ?? []), [0, name]]);
    }
    for (const curves of groups.values())
      for (let first = 0; first < curves.length; first += IN_PLOT)
        this.add(curves.slice(first, first + IN_PLOT), this.addPlot("time"));
    if (!groups.size) this.addPlot("time");
    this.choose(this.charts[0]);
  }
}

// The page around the desk: tree, tools, layouts; inputs of a running command.
async function startView(inputs = null) {
  const about = await (await fetch("about")).json(),
    desk = new Desk(about, inputs !== null),
    { runs } = desk;
  let { layouts } = about;
  const fail = (place, error) => {
    place.hidden = !error;
    put(place, error?.message ?? "");
  };
  const attempt = async (place, deed) => {
    try {
      fail(place, null);
      await deed();
    } catch (error) {
      fail(place, error);
    }
  };
  for (const media of [paper, matchMedia("(prefers-color-scheme: dark)")])
    // paper takes lines in place of pixels
    media.addEventListener("change", () => desk.draw(desk.near));
  addEventListener("dragend", () => (desk.dragged = null));

  // -- tree ---------------------------------------------------------------------------------------------
  const tree = new SignalTree(one("#tree"), runs, (curves, isNew) => {
    desk.add(curves, isNew ? desk.addPlot("time") : desk.active);
  });
  const renew = () => {
    tree.tries.clear();
    tree.union = null;
    tree.fill();
    const total = runs.reduce((sum, run) => sum + run.names.length, 0);
    put(one("#count"), `${total} signals${runs.length > 1 ? ` of ${runs.length} runs` : ""}`);
  };
  one("#find").oninput = (event) => tree.search(event.target.value.trim());
  one("#find").onkeydown = (event) => {
    if (event.key === "ArrowDown") one("#tree").focus();
  };
  one("#group").onchange = (event) => tree.regroup(event.target.value);
  desk.accept(one("#new-plot"), (curves) => {
    if (desk.dragged) desk.dragged.plot.take(desk.dragged.curve);
    desk.add(curves, desk.addPlot("time"));
  });
  one("#whole").onclick = () => desk.home();
  one("#add").onclick = () => desk.addPlot("time").title.focus();
  one("#add-plane").onclick = () => desk.addPlot("xy").title.focus();
  one("#add-spectrum").onclick = () => desk.addPlot("spectrum").title.focus();
  one("#columns").onchange = (event) => desk.arrange(Number(event.target.value));
  for (const field of [one("#from"), one("#to")])
    field.onchange = () => {
      const [from, to] = [one("#from"), one("#to")].map((f) => Number(f.value.replace("\u2212", "-")));
      if (from < to) desk.look(from, to);
      else desk.looked();
    };

  // -- layouts ------------------------------------------------------------------------------------------
  const inLayouts = (deed) => attempt(one("#layout-error"), deed);
  async function putLayout(label, content) {
    layouts = await post("layouts", { name: label, layout: content });
    listLayouts();
    desk.tell(content ? `Layout ${label} is saved.` : `Layout ${label} is removed.`);
  }
  function listLayouts() {
    const entry = (label) => {
      const show = () => {
        one("#layout-name").value = label;
        inLayouts(() => desk.open(layouts[label]));
      };
      const away = () => inLayouts(() => putLayout(label, null));
      const parts = [button(label, show, { class: "act" })];
      return make("li", {}, ...parts, button("×", away, { class: "away", "aria-label": `Remove the layout ${label}` }));
    };
    one("#layout-list").replaceChildren(...Object.keys(layouts).map(entry));
  }
  one("#layout-form").onsubmit = (event) => {
    event.preventDefault();
    return inLayouts(() => putLayout(one("#layout-name").value.trim(), desk.layout()));
  };
  listLayouts();

  // -- start --------------------------------------------------------------------------------------------
  const first = layouts.last ?? layouts[Object.keys(layouts)[0]];
  renew();
  if (inputs) desk.plotFirst(inputs);
  else desk.plotJudged();
  desk.home();
  if (first) await inLayouts(() => desk.open(first));
  new ResizeObserver(() => desk.looked()).observe(one("#charts"));
  addEventListener("beforeprint", () => {
    const drawn = [...new Set(desk.charts.flatMap((plot) => plot.curves.map((c) => c.run)))].sort((a, b) => a - b);
    one("#paper-runs").replaceChildren(...drawn.map((run) => make("li", {}, `${runs[run].label}: ${runs[run].file}`)));
    desk.draw(desk.charts);
  });
  document.documentElement.dataset.ready = "view";
  return desk;
}
