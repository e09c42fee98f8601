// Charts that can be looked into: zoom by dragging, by keys or with two fingers, all charts of an axis together; curves
// that can be hidden; pictures and numbers of what is shown. What is drawn at first is what the page came with.
/* global axis, logAxis, escapeText, tag, pen, save, savePng, safeName */
document.addEventListener("rows", (event) => {
  "use strict";
  const page = event.detail,
    { axis: ours, data, locate } = page,
    time = data.t,
    count = time.length;
  const W = 4000,
    H = 1000,
    LEAST = 2; // the box of a chart; rows that a view shows at least
  const [, HELD, DOTS, STEMS, , CROSSES] = [0, 1, 2, 3, 4, 5]; // ways of drawing; 0 is a line, 4 are bars
  const whole = { from: ours.ends[0], to: ours.ends[1] },
    breaks = data.breaks ?? [];
  let view = { ...whole };

  const all = (selector, root) => [...root.querySelectorAll(selector)];
  const make = (name, attributes = {}, text = "") => {
    const element = document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    element.textContent = text;
    return element;
  };

  // Fewer ticks where their labels are long.
  function across(width) {
    if (data.log) return logAxis(view.from, view.to);
    const full = axis(view.from, view.to, 6);
    const long = 9 * Math.max(0, ...full.ticks.map((t) => t.label.length));
    const fits = long * full.ticks.length < width;
    return fits ? full : axis(view.from, view.to, Math.max(1, Math.floor(width / (long + 20))));
  }

  // -- drawing -----------------------------------------------------------------------------------
  // Rows of the view, and one beyond each end, so that curves go through to the edge.
  function rowsInView() {
    const [row, share] = locate(view.to);
    let [low] = locate(view.from),
      high = Math.min(count - 1, row + (share > 0 ? 1 : 0));
    while (low > 0 && time[low - 1] === time[low]) low--;
    while (high < count - 1 && time[high + 1] === time[high]) high++;
    return [low, high];
  }

  // Rows of the least and the largest value of every TILE rows, −1 where there is none: a look at a long run need not
  // go through its rows.
  const TILE = 16;
  function tilesOf(series) {
    if (series.tiles) return series.tiles;
    const { v } = series,
      size = Math.ceil(count / TILE),
      least = new Int32Array(size).fill(-1),
      most = new Int32Array(size).fill(-1);
    for (let row = 0; row < count; row++) {
      const value = v[row],
        tile = row >> 4;
      if (Number.isNaN(value)) continue;
      if (least[tile] < 0 || value < v[least[tile]]) least[tile] = row;
      if (most[tile] < 0 || value > v[most[tile]]) most[tile] = row;
    }
    return (series.tiles = { least, most });
  }

  // Rows of the least and the largest value from `begin` up to `end`; by tiles where both lie between two.
  function extremes(series, begin, end) {
    const { v } = series;
    let least = -1,
      most = -1;
    const see = (low, high) => {
      if (low >= 0 && (least < 0 || v[low] < v[least])) least = low;
      if (high >= 0 && (most < 0 || v[high] > v[most])) most = high;
    };
    if (begin % TILE === 0 && end - begin >= TILE) {
      const tiles = tilesOf(series),
        last = Math.floor(end / TILE);
      for (let tile = begin / TILE; tile < last; tile++) see(tiles.least[tile], tiles.most[tile]);
      begin = last * TILE;
    }
    for (let row = begin; row < end; row++) if (!Number.isNaN(v[row])) see(row, row);
    return [least, most];
  }

  // Least and largest of the rows in each column of the picture: no peak is lost, however many rows there are.
  function path(series, [low, high], x, y, columns, cap = 18, [lw, lh] = [28, 17]) {
    if (data.sparse) [low, high] = [0, count - 1]; // few rows; a line has its next point further out
    if (series.way > HELD) return marks(series, [low, high], x, y, cap, cap === 18 ? 11 : cap);
    const { v, anew } = series,
      held = series.way === HELD,
      parts = [];
    let bucket = data.sparse ? 1 : Math.max(1, Math.floor((high - low) / columns));
    if (bucket >= TILE) {
      low -= low % TILE;
      bucket -= bucket % TILE;
    }
    // a sample between two gaps is a cross
    const lone = `m${-lw} 0h${2 * lw}m${-lw} ${-lh}v${2 * lh}`,
      lift = () => {
        if (alone) parts.push(lone);
        pen = alone = false;
      };
    let pen = false,
      alone = false,
      coming = breaks.findIndex((row) => row > low);
    const put = (row) => {
      const a = Math.round(x(time[row])),
        b = Math.round(y(v[row]));
      parts.push(!pen ? `M${a} ${b}` : held ? `H${a}V${b}` : `L${a} ${b}`);
      alone = !pen;
      pen = true;
    };
    for (let begin = low; begin <= high; begin += bucket) {
      const end = Math.min(high + 1, begin + bucket);
      while (anew && coming >= 0 && breaks[coming] <= begin) {
        lift();
        coming = coming + 1 < breaks.length ? coming + 1 : -1;
      }
      const [least, most] = extremes(series, begin, end);
      if (least < 0) {
        if (!data.sparse) lift();
        continue;
      }
      for (const row of least === most ? [least] : least < most ? [least, most] : [most, least]) put(row);
    }
    lift();
    return parts.join("");
  }

  // Points, crosses, stems from zero, bars with caps: each value by itself.
  function marks({ v, upper, way, shift }, [low, high], x, y, cap, rise) {
    const parts = [],
      zero = y(0).toFixed(0);
    for (let row = low; row <= high; row++) {
      if (Number.isNaN(v[row])) continue;
      const a = x(time[row] + shift).toFixed(0),
        b = y(v[row]).toFixed(0);
      parts.push(
        way === DOTS
          ? `M${a} ${b}h0`
          : way === CROSSES
            ? `M${a - 2 * cap} ${b - 2 * rise}l${4 * cap} ${4 * rise}m${-4 * cap} 0l${4 * cap} ${-4 * rise}`
            : way === STEMS
              ? `M${a} ${zero}V${b}`
              : `M${a - cap} ${b}h${2 * cap}m${-cap} 0V${y(upper[row]).toFixed(0)}m${-cap} 0h${2 * cap}`,
      );
    }
    return parts.join("");
  }

  function bandPath([lower, upper], [low, high], x, y, columns) {
    const rows = [],
      step = data.sparse ? 1 : Math.max(1, Math.floor((high - low) / columns));
    let text = "",
      stretch = [];
    if (data.sparse) [low, high] = [0, count - 1];
    const close = () => {
      if (stretch.length)
        text +=
          "M" +
          stretch.map((r) => `${x(time[r]).toFixed(0)} ${y(upper.v[r]).toFixed(0)}`).join("L") +
          "L" +
          stretch
            .reverse()
            .map((r) => `${x(time[r]).toFixed(0)} ${y(lower.v[r]).toFixed(0)}`)
            .join("L") +
          "z";
      stretch = [];
    };
    for (let row = low; row <= high; row += step) rows.push(row);
    for (const row of rows) {
      if (!Number.isNaN(lower.v[row]) && !Number.isNaN(upper.v[row])) stretch.push(row);
      else if (!data.sparse) close();
    }
    close();
    return text;
  }

  class Chart {
    constructor(figure) {
      this.figure = figure;
      this.box = figure.querySelector("[data-box]");
      this.svg = figure.querySelector(".box svg");
      this.lines = all("[data-line]", figure).map((p) => ({
        path: p,
        key: p.dataset.line,
        series: data.series[p.dataset.line],
        on: true,
        label: "",
      }));
      this.band = figure.querySelector("[data-band]");
      this.edges = this.band ? this.band.dataset.band.split(" ").map((key) => data.series[key]) : null;
      this.levels = all("[data-level]", figure).map((p) => ({ path: p, value: Number(p.dataset.level) }));
      this.uprights = all("[data-upright]", figure).map((p) => ({ path: p, value: Number(p.dataset.upright) }));
      this.also = all(".legend output", figure)
        .filter((o) => !o.closest("[data-toggle]"))
        .map((o) => ({ series: data.series[o.dataset.key], label: o.previousSibling.textContent.trim(), on: true }));
      this.reach = figure.dataset.reach?.split(" ").map(Number);
      this.grid = figure.querySelector(".grid");
      this.zero = figure.querySelector(".zero");
      this.yTicks = figure.querySelector(".y-ticks");
      this.xTicks = figure.querySelector(".x-ticks");
      this.factors = [figure.querySelector(".factor"), figure.querySelector(".x-label span")];
      // The page came with the whole view: what svg.py has drawn comes back as it was.
      const texts = [this.grid, this.yTicks, this.xTicks, ...this.factors].map((e) => [e, e.innerHTML]);
      const shapes = all(":scope > path", this.svg).map((p) => [p, p.getAttribute("d")]);
      this.original = () => {
        for (const [element, text] of texts) element.innerHTML = text;
        for (const [path, shape] of shapes) path.setAttribute("d", shape);
      };
      this.stale = false;
      this.near = true;
      this.width = 500;
    }

    // Before anything is drawn: asking for a width between two drawings lays the page out again.
    measure() {
      this.width = this.box.clientWidth || 500;
      return this;
    }

    get atHome() {
      return view.from === whole.from && view.to === whole.to && this.lines.every((l) => l.on);
    }

    range(rows) {
      let low = Infinity,
        high = -Infinity;
      const see = (v) => {
        for (let k = rows[0]; k <= rows[1]; k++) {
          if (v[k] < low) low = v[k];
          if (v[k] > high) high = v[k];
        }
      };
      // whole tiles by their extremes, the rows before the first one by themselves
      const seeAll = (series) => {
        const first = Math.min(rows[1] + 1, Math.ceil(rows[0] / TILE) * TILE),
          { v } = series;
        for (const [begin, end] of [
          [rows[0], first],
          [first, rows[1] + 1],
        ]) {
          const [least, most] = extremes(series, begin, end);
          if (least >= 0) [low, high] = [Math.min(low, v[least]), Math.max(high, v[most])];
        }
      };
      for (const { on, series } of this.lines) {
        if (!on) continue;
        seeAll(series);
        if (series.upper) see(series.upper);
        if (series.way === STEMS) [low, high] = [Math.min(0, low), Math.max(0, high)];
      }
      if (low > high) return null;
      if (this.atFull)
        for (const level of this.levels) {
          low = Math.min(low, level.value);
          high = Math.max(high, level.value);
        }
      const margin = 0.06 * (high - low) || 0.1 * Math.abs(high) || 1;
      return [low - margin, high + margin];
    }

    get atFull() {
      return view.from === whole.from && view.to === whole.to;
    }

    axes() {
      const rows = rowsInView(),
        angle = this.figure.dataset.unit === "\u00b0";
      const ends = this.atFull && this.reach ? this.reach : this.range(rows);
      const y = ends ? axis(...ends, 5, angle) : { low: 0, high: 1, ticks: [], factor: "" },
        x = across(this.width);
      return {
        rows,
        x,
        y,
        u: (t) => (W * (t - view.from)) / (view.to - view.from),
        v: (value) => H * (1 - Math.max(-9, Math.min(10, (value - y.low) / (y.high - y.low)))),
      };
    }

    draw() {
      this.stale = false;
      for (const line of this.lines) line.path.toggleAttribute("hidden", !line.on);
      if (this.atHome) {
        this.original();
        return;
      }
      const { rows, x, y, u, v } = this.axes();
      const columns = Math.max(200, this.width);
      const labels = (ticks, side) => ticks.map((t) => `<span style="${side}:${t.at.toFixed(2)}%">${t.label}</span>`);
      this.grid.innerHTML = [
        ...y.ticks.map((t) => `<path d="M0 ${(H - (H * t.at) / 100).toFixed(0)}h${W}"/>`),
        ...x.ticks.map((t) => `<path d="M${((W * t.at) / 100).toFixed(0)} 0v${H}"/>`),
      ].join("");
      this.factors[0].textContent = y.factor;
      this.factors[1].textContent = x.factor;
      this.yTicks.innerHTML = labels(y.ticks, "bottom").join("");
      this.xTicks.innerHTML = labels(x.ticks, "left").join("");
      for (const line of this.lines) if (line.on) line.path.setAttribute("d", path(line.series, rows, u, v, columns));
      if (this.band) this.band.setAttribute("d", bandPath(this.edges, rows, u, v, columns));
      for (const level of this.levels) level.path.setAttribute("d", `M0 ${v(level.value).toFixed(0)}h${W}`);
      for (const { path, value } of this.uprights) {
        const shown = view.from <= value && value <= view.to;
        path.setAttribute("d", shown ? `M${u(value).toFixed(0)} 0v${H}` : "");
      }
      if (this.zero) this.zero.setAttribute("d", y.low < 0 && y.high > 0 ? `M0 ${v(0).toFixed(0)}h${W}` : "");
    }

    describe() {
      const row = page.at(),
        unit = this.figure.dataset.unit.replace("no unit declared", "");
      const values = this.lines.filter((l) => l.on).map((l) => `${l.label} ${page.read(l.series, row)} ${unit}`.trim());
      values.push(...this.also.map((a) => `${a.label} ${page.read(a.series, row)}`));
      return `${ours.place(row)}: ${values.join(", ")}`;
    }

    // Of points in a plane the one nearest to a place in the box, as shares of it.
    nearest(along, up) {
      const { u, v } = this.axes(),
        { clientWidth: w, clientHeight: h } = this.box,
        points = this.lines[0].series.v;
      let best = 0,
        least = Infinity;
      for (let row = 0; row < count; row++) {
        const away = Math.hypot(w * (u(time[row]) / W - along), h * (v(points[row]) / H - up));
        if (away < least) [best, least] = [row, away];
      }
      return best;
    }
    ring() {
      const { v } = this.axes(),
        at = v(this.lines[0].series.v[page.at()]) / H;
      this.figure.style.setProperty("--height", `${(100 * at).toFixed(2)}%`);
    }
  }

  // Only charts that are seen are drawn at once; the others when they come into sight, or are printed.
  const charts = page.figures.map((figure) => new Chart(figure));
  const watcher = new IntersectionObserver(
    (entries) => {
      for (const entry of entries) {
        const chart = charts.find((c) => c.figure === entry.target);
        chart.near = entry.isIntersecting;
        if (chart.near && chart.stale) chart.measure().draw();
      }
    },
    { rootMargin: "300px" },
  );
  for (const chart of charts) watcher.observe(chart.figure);
  addEventListener("beforeprint", () => {
    for (const chart of charts) if (chart.stale) chart.measure().draw();
  });

  function look(from, to) {
    const least = (LEAST * (whole.to - whole.from)) / Math.max(1, count - 1);
    if (to - from < least) [from, to] = [(from + to - least) / 2, (from + to + least) / 2];
    if (to - from >= whole.to - whole.from) [from, to] = [whole.from, whole.to];
    if (from < whole.from) [from, to] = [whole.from, whole.from + to - from];
    if (to > whole.to) [from, to] = [whole.to - (to - from), whole.to];
    view = { from, to };
    page.look(from, to);
    for (const host of ours.hosts) host.classList.toggle("zoomed", from !== whole.from || to !== whole.to);
    for (const chart of charts) if (chart.near) chart.measure();
    for (const chart of charts) {
      chart.stale = true;
      if (chart.near) chart.draw();
    }
  }
  const home = () => look(whole.from, whole.to);
  function scale(factor, about) {
    look(about - (about - view.from) * factor, about + (view.to - about) * factor);
  }

  // -- pointer, fingers, keys ------------------------------------------------------------------------
  let announcer = document.querySelector("p.told");
  if (!announcer) {
    announcer = make("p", { class: "unseen told", role: "status", "aria-live": "polite" });
    document.body.append(announcer);
  }
  const timeAt = (box, x) => {
    const frame = box.getBoundingClientRect();
    return view.from + (view.to - view.from) * Math.min(1, Math.max(0, (x - frame.left) / frame.width));
  };
  const nearest = (t) => ours.near(t);
  // Some rows on; of rows that stand at one place of the axis no more than one.
  function rowBeyond(row, some) {
    let to = Math.min(count - 1, Math.max(0, row + some));
    if (data.points) return to; // one above another too
    while (time[to] === time[row] && to > 0 && to < count - 1) to += Math.sign(some);
    return to;
  }

  function listen(chart) {
    const { box } = chart,
      fingers = new Map();
    let dragStart = null,
      mark = null,
      apart = 0;
    const under = (event) => {
      const frame = box.getBoundingClientRect();
      return data.points
        ? chart.nearest((event.clientX - frame.left) / frame.width, (event.clientY - frame.top) / frame.height)
        : nearest(timeAt(box, event.clientX));
    };
    const unmark = () => {
      mark?.remove();
      mark = null;
      dragStart = null;
    };
    box.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      box.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, event.clientX);
      if (event.pointerType !== "touch") dragStart = event.clientX;
      if (fingers.size === 2) {
        const [a, b] = fingers.values();
        apart = Math.max(8, Math.abs(a - b));
      }
      page.seek(under(event));
    });
    box.addEventListener("pointermove", (event) => {
      if (fingers.has(event.pointerId)) fingers.set(event.pointerId, event.clientX);
      if (fingers.size === 2) {
        const [a, b] = fingers.values(),
          now = Math.max(8, Math.abs(a - b));
        scale(apart / now, timeAt(box, (a + b) / 2));
        apart = now;
        return;
      }
      page.seek(under(event));
      if (dragStart === null || Math.abs(event.clientX - dragStart) < 5) return;
      mark ??= box.appendChild(make("span", { class: "marked", "aria-hidden": "true" }));
      const frame = box.getBoundingClientRect(),
        ends = [dragStart, event.clientX]
          .map((x) => Math.min(frame.right, Math.max(frame.left, x)) - frame.left)
          .sort((p, q) => p - q);
      mark.style.left = ends[0] + "px";
      mark.style.width = ends[1] - ends[0] + "px";
    });
    const up = (event) => {
      fingers.delete(event.pointerId);
      if (mark) look(...[timeAt(box, dragStart), timeAt(box, event.clientX)].sort((p, q) => p - q));
      else if (event.type === "pointerup") page.settle(under(event));
      unmark();
    };
    box.addEventListener("pointerup", up);
    box.addEventListener("pointercancel", (event) => {
      fingers.delete(event.pointerId);
      unmark();
    });
    // a finger that has left still reads: its row stays until another place is touched
    box.addEventListener("pointerleave", (event) => {
      if (event.pointerType !== "touch") page.rest();
    });
    box.addEventListener("blur", page.rest);
    box.addEventListener("dblclick", home);
    box.addEventListener(
      "wheel",
      (event) => {
        // a wheel alone scrolls the page
        if (!event.ctrlKey && !event.metaKey) return;
        event.preventDefault();
        scale(event.deltaY > 0 ? 1.25 : 0.8, timeAt(box, event.clientX));
      },
      { passive: false },
    );
    box.addEventListener("keydown", (event) => {
      if (event.altKey || event.ctrlKey || event.metaKey) return;
      const row = page.at(),
        some = event.shiftKey ? Math.max(1, Math.round((rowsInView()[1] - rowsInView()[0]) / 20)) : 1,
        [low, high] = rowsInView();
      const rows = { ArrowLeft: rowBeyond(row, -some), ArrowRight: rowBeyond(row, some), Home: low, End: high };
      if (event.key in rows) page.settle(Math.min(count - 1, Math.max(0, rows[event.key])));
      else if (event.key === "+" || event.key === "=") scale(0.5, time[page.at()]);
      else if (event.key === "-") scale(2, time[page.at()]);
      else if (event.key === "0" || event.key === "Escape") home();
      else return;
      event.preventDefault();
      const t = time[page.at()],
        width = view.to - view.from;
      if (t < view.from || t > view.to) look(t - width / 2, t + width / 2);
      announcer.textContent = chart.describe();
    });
    box.tabIndex = 0;
    box.setAttribute("role", "application");
    box.setAttribute("aria-roledescription", "chart");
    box.setAttribute(
      "aria-label",
      `${chart.figure.dataset.title}: arrow keys move the cursor from row to row, plus and minus zoom, 0 shows all`,
    );
  }

  // -- legend ----------------------------------------------------------------------------------------
  function toggles(chart) {
    for (const entry of all("[data-toggle]", chart.figure)) {
      const line = chart.lines.find((l) => l.key === entry.dataset.toggle);
      line.label = entry.querySelector("span").textContent;
      if (chart.lines.length < 2) continue;
      const button = make("button", { type: "button", class: "entry", "aria-pressed": "true", title: "show or hide" });
      button.append(...entry.childNodes);
      entry.replaceWith(button);
      button.addEventListener("click", () => {
        line.on = !line.on;
        button.setAttribute("aria-pressed", String(line.on));
        chart.measure().draw();
      });
    }
  }

  // -- pictures and numbers ------------------------------------------------------------------------------
  function picture(chart) {
    if (chart.stale) chart.draw();
    const { rows, x, y, u, v } = chart.measure().axes();
    const [width, height, top, right, bottom] = [900, 420, 56, 20, 46];
    const left = Math.max(70, chart.yTicks.offsetWidth + 8);
    const [wide, high] = [width - left - right, height - top - bottom];
    const px = (t) => left + (wide * u(t)) / W;
    const py = (value) => top + (high * v(value)) / H;
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(name).trim();
    const stroke = (d, look) => tag("path", { fill: "none", d, ...look });
    const level = (at, look) => stroke(`M${left} ${at.toFixed(1)}h${wide}`, look);
    const upright = (at, look) => stroke(`M${at.toFixed(1)} ${top}v${high}`, look);
    const words = (a, b, text, look) => tag("text", { x: a, y: b, ...look }, escapeText(text));
    const grid = { stroke: colour("--grid") };
    const limit = { stroke: colour("--reference"), "stroke-dasharray": "5 4" };
    const shade = { fill: colour("--band"), "fill-opacity": colour("--band-alpha") };
    const lines = chart.lines.filter((l) => l.on).map((l) => ({ ...l, look: pen(l.path) }));
    const shapes = [
      chart.band ? stroke(bandPath(chart.edges, rows, px, py, wide), shade) : "",
      ...chart.levels.map((l) => level(py(l.value), limit)),
      ...chart.uprights.map((p) => upright(px(p.value), limit)),
      ...lines.map((l) => stroke(path(l.series, rows, px, py, wide, 4, [4, 4]), l.look)),
    ];
    let along = left;
    const legend = lines.map(({ label, look }) => {
      const at = along;
      along += 52 + 7.2 * label.length;
      return stroke(`M${at} 40h22`, look) + words(at + 28, 44, label);
    });
    const rise = (tick) => top + high * (1 - tick.at / 100);
    const run = (tick) => left + (wide * tick.at) / 100;
    const { title, unit } = chart.figure.dataset;
    const parts = [
      tag("rect", { width, height, fill: colour("--card") }),
      ...y.ticks.map((t) => level(rise(t), grid) + words(left - 8, rise(t) + 4, t.label, { "text-anchor": "end" })),
      ...x.ticks.map((t) => upright(run(t), grid)),
      ...x.ticks.map((t) => words(run(t), top + high + 18, t.label, { "text-anchor": "middle" })),
      tag(
        "svg",
        { x: left, y: top, width: wide, height: high, viewBox: `${left} ${top} ${wide} ${high}` },
        shapes.join(""),
      ),
      ...legend,
      words(left + 6, top + 16, y.factor),
      words(left, 22, `${title} [${unit}]`, { "font-weight": 600, "font-size": 15 }),
      words(width - right, height - 10, `${over(chart)} ${x.factor}`, { "text-anchor": "end" }),
    ];
    const font = { "font-family": "system-ui, sans-serif", "font-size": 12, fill: colour("--ink") };
    const box = { xmlns: chart.svg.namespaceURI, width, height, viewBox: `0 0 ${width} ${height}` };
    return tag("svg", { ...box, ...font }, parts.join(""));
  }

  const over = (chart) => chart.figure.querySelector(".x-label").firstChild.data.trim();
  const titles = ({ label, series }) => (series.upper ? [`${label}, lower`, `${label}, upper`] : [label]);
  function numbers(chart) {
    const quote = (words) => (/[",\n]/.test(words) ? `"${words.replaceAll('"', '""')}"` : words),
      unit = chart.figure.dataset.unit;
    const lines = chart.lines.filter((l) => l.on),
      [low, high] = rowsInView(),
      rows = [
        [
          quote(over(chart)),
          ...lines.flatMap((l) => titles(l).map((t) => quote(`${t} [${unit}]`))),
          ...chart.also.map((a) => quote(a.label)),
        ].join(","),
      ];
    for (let row = low; row <= high; row++) {
      const cell = (series, v) => (Number.isNaN(v[row]) ? "" : series.text(v[row]));
      const cells = [...lines, ...chart.also].flatMap(({ series }) =>
        [series.v, ...(series.upper ? [series.upper] : [])].map((v) => cell(series, v)),
      );
      if (!data.sparse || cells.some(Boolean))
        rows.push([ours.text(row), ...cells].join(",").replaceAll("\u2212", "-"));
    }
    return rows.join("\n") + "\n";
  }

  const nameCounts = new Map();

  function fileName(chart) {
    const { title, unit } = chart.figure.dataset,
      alike = charts.filter((c) => safeName(c.figure.dataset.title) === safeName(title)).length > 1;
    const name = (safeName(title) || "chart") + (alike ? "_" + safeName(unit) : ""),
      count = (nameCounts.get(name) || 0) + 1;
    nameCounts.set(name, count);
    return count > 1 ? `${name}-${count}` : name;
  }

  function tools(chart) {
    const row = make("span", { class: "tools" }),
      name = fileName(chart);
    const ways = {
      PNG: () => savePng(picture(chart), name + ".png"),
      SVG: () => save(new Blob([picture(chart)], { type: "image/svg+xml" }), name + ".svg"),
      CSV: () => save(new Blob([numbers(chart)], { type: "text/csv" }), name + ".csv"),
    };
    for (const [kind, action] of Object.entries(ways)) {
      const button = make(
        "button",
        {
          type: "button",
          title: `save what this chart shows as ${kind}`,
          "aria-label": `${chart.figure.dataset.title} as ${kind}`,
        },
        kind,
      );
      button.addEventListener("click", action);
      row.append(button);
    }
    const back = make(
      "button",
      { type: "button", class: "back", title: "show all of the axis again" },
      ours.symbol === "t" ? "whole run" : "all",
    );
    back.addEventListener("click", home);
    row.append(back);
    chart.figure.querySelector(".axes").append(row);
  }

  for (const chart of charts) {
    toggles(chart);
    tools(chart);
    listen(chart);
    if (data.points) ours.moved.push(() => chart.ring());
  }
});
