// A report: unpacks its rows, draws its charts, moves the cursors of each axis together, plays what moves.
/* global one, all, make, button, put, fixed, MISSING, MINUS, save, safeName, lastUpTo, extremes, Linked, Chart */
(async () => {
  "use strict";
  const page = JSON.parse(one("#run-data").textContent),
    root = document.documentElement,
    unfolded = [];
  for (const box of all(".scroll:not([tabindex]), pre")) scrollable(box);
  addEventListener("beforeprint", () => {
    for (const part of all("details:not([open])")) unfolded.push(Object.assign(part, { open: true }));
    for (const group of groups ?? []) group.draw(group.charts.filter((chart) => chart.isStale));
  });
  addEventListener("afterprint", () => {
    for (const part of unfolded.splice(0)) part.open = false;
  });
  let groups = null;

  // A table or a command that is wider than the page is scrolled by keys too.
  function scrollable(box) {
    const name = one("caption", box)?.textContent.trim() || (box.matches("pre") ? "Command" : "Table");
    const fit = () => {
      const isWide = box.scrollWidth > box.clientWidth + 1;
      for (const [key, value] of Object.entries({ tabindex: "0", role: "region", "aria-label": name }))
        if (isWide) box.setAttribute(key, value);
        else box.removeAttribute(key);
    };
    new ResizeObserver(fit).observe(box);
    fit();
  }

  // What charts.py packed: differences as zigzag numbers, the lowest byte of each row first.
  async function unpack() {
    const bytes = Uint8Array.from(atob(page.packed), (c) => c.charCodeAt(0)),
      stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate")),
      raw = new Uint8Array(await new Response(stream).arrayBuffer());
    let at = 0;
    return page.columns.map(([rows, decimals, hasGaps]) => {
      const v = new Float64Array(rows),
        scale = 10 ** Math.abs(decimals);
      for (let k = 0, sum = 0; k < rows; k++) {
        let zigzag = 0;
        for (let part = 6; part >= 0; part--) zigzag = 256 * zigzag + raw[at + part * rows + k];
        sum += zigzag % 2 ? -(zigzag + 1) / 2 : zigzag / 2;
        v[k] = decimals < 0 ? sum * scale : sum / scale;
      }
      at += 7 * rows;
      if (hasGaps) for (let k = 0; k < rows; k++) if (!raw[at++]) v[k] = NaN;
      return { v, decimals, text: textOf(v, decimals) };
    });
  }
  // A value as it stands on its grid: all decimals it has, or an exponent where these would be too many.
  function textOf(values, decimals) {
    let largest = 0;
    for (const v of values) if (Math.abs(v) > largest) largest = Math.abs(v);
    const lead = largest > 0 ? Math.floor(Math.log10(largest)) : 0,
      isPlain = lead < 9 && (decimals <= 7 || (lead >= 0 && decimals <= 12));
    return (v) => {
      if (Number.isNaN(v)) return MISSING;
      if (isPlain || v === 0) return fixed(v, isPlain ? Math.max(0, decimals) : 0);
      const digits = Math.max(0, Math.min(20, Math.floor(Math.log10(Math.abs(v))) + decimals));
      return v.toExponential(digits).replaceAll("-", MINUS);
    };
  }
  // The row of sorted values that is nearest to a value.
  function near(values, at) {
    const row = Math.max(0, lastUpTo(values, at));
    return row + 1 < values.length && values[row + 1] - at < at - values[row] ? row + 1 : row;
  }
  // Where a drawing stands between two rows; where the next row has none the last one stays. No number is shown of it.
  function between(values, row, share) {
    const [a, b] = [values[row], values[row + 1]];
    return a === null || a === undefined || b === null || b === undefined ? a : a + share * (b - a);
  }
  function locate(t, times) {
    const row = Math.max(0, Math.min(times.length - 2, lastUpTo(times, t)));
    if (t >= times.at(-1)) return [times.length - 1, 0];
    return [row, Math.min(1, Math.max(0, (t - times[row]) / (times[row + 1] - times[row] || 1)))];
  }

  const play = one("#play"),
    scrub = one("#scrub"),
    rowNote = one("#row");
  let columns = [];
  const column = (key) => columns[key]?.v ?? null; // null without a key
  const announcer = document.body.appendChild(
    make("p", { class: "unseen told", role: "status", "aria-live": "polite" }),
  );

  // Charts over one axis. Numbers are those of a row that was recorded, and never made up between two; of curves with
  // points of their own, those nearest.
  class Group extends Linked {
    constructor(about, isOnly) {
      const { v, decimals } = columns[about.x],
        scaled = about.log ? v.map(Math.log10) : v,
        own = about.ends?.map((end) => (about.log ? Math.log10(end) : end)),
        [from, to] = own ?? (v.length > 1 ? [scaled[0], scaled.at(-1)] : [scaled[0] - 0.5, scaled[0] + 0.5]);
      super(from, to > from ? to : from + 1);
      Object.assign(this, { about, x: scaled, v, decimals, log: about.log, isOnly, nearest: v.length - 1 });
      this.least = (2 * (this.whole.to - this.whole.from)) / Math.max(1, v.length - 1);
      const [name, unit] = about.over;
      this.symbol = name === "time" ? "t" : name;
      this.suffix = unit === "1" || !unit ? "" : ` ${unit}`;
      this.label = `${name} [${unit || "1"}]`;
    }
    add(figure, spec) {
      const chart = new ReportChart(this, figure, spec);
      this.charts.push(chart);
      watcher.observe(figure);
      return chart;
    }
    get isMain() {
      return this === groups[0];
    }
    looked() {
      for (const host of this.hosts()) host.classList.toggle("zoomed", !this.isWhole);
      this.mark(...this.hosts());
      for (const chart of this.charts) chart.isStale = true;
      this.draw(this.charts.filter((chart) => chart.isNear));
    }
    hosts() {
      return this.isOnly ? [root] : this.charts.map(({ figure }) => figure);
    }
    text(row) {
      return this.format(this.v[row]);
    }
    format(value) {
      const isTime = this.about.over[0] === "time" && this.about.over[1] === "s",
        digits = isTime ? value.toFixed(Math.max(0, this.decimals)) : value.toPrecision(5);
      return String(Number(digits)).replaceAll("-", MINUS);
    }
    place(row) {
      return `${this.symbol} = ${this.text(row)}${this.suffix}`;
    }
    // begin where something can be read
    start() {
      const every = this.charts.flatMap((chart) => chart.curves.filter((c) => !c.x));
      const row = this.v.findLastIndex((_, k) => every.every(({ values }) => !Number.isNaN(values[k])));
      return row < 0 ? this.nearest : row;
    }
    // isRead: name the row at the foot of the page, while a chart is read
    to(row, isRead = false) {
      this.nearest = row;
      this.cursor = this.x[row];
      for (const chart of this.charts) chart.read();
      if (this.isMain)
        for (const cell of all("[data-key]"))
          put(cell, columns[cell.dataset.key].text(columns[cell.dataset.key].v[row]));
      this.mark(...this.hosts());
      if (!isRead || !rowNote) return;
      const { of, every, points } = this.about,
        count = this.v.length,
        hasOwn = this.charts.some((chart) => chart.curves.some((c) => c.x));
      rowNote.hidden = false;
      rowNote.textContent = points
        ? `numbers: point ${row + 1} of ${count}, ${this.place(row)}`
        : hasOwn
          ? `numbers: the point of each curve nearest to ${this.place(row)}`
          : `numbers: row ${Math.min(of, 1 + row * every)} of ${of}, ${this.place(row)}` +
            (of > count ? `; ${count} of the rows are in this page, all are in results.csv` : "");
    }
    seek(at, chart, event) {
      const row = this.about.points ? chart.nearestPoint(event) : near(this.x, at);
      if (!this.isMain || !play) this.to(row, true);
      else if (!playing) show(this.v[row], true);
    }
    settle(row) {
      if (this.isMain && play) jump(this.v[row], true);
      else this.to(row, true);
      if (this.isMain) remember();
    }
    click() {
      this.settle(this.nearest);
    }
    rest() {
      if (rowNote) rowNote.hidden = true;
    }
    // Some rows on; of rows that stand at one place of the axis no more than one.
    beyond(some) {
      const last = this.x.length - 1,
        from = this.nearest;
      let to = Math.min(last, Math.max(0, from + some));
      if (this.about.points) return to; // one above another too
      while (this.x[to] === this.x[from] && to > 0 && to < last) to += Math.sign(some);
      return to;
    }
    keys(chart, event) {
      const [first, last] = [this.view.from, this.view.to].map((end) => near(this.x, end)),
        some = event.shiftKey ? Math.max(1, Math.round((last - first) / 20)) : 1,
        go = (row) => () => {
          this.settle(row);
          const width = this.view.to - this.view.from;
          if (this.cursor < this.view.from || this.cursor > this.view.to)
            this.look(this.cursor - width / 2, this.cursor + width / 2);
        };
      return { ArrowLeft: go(this.beyond(-some)), ArrowRight: go(this.beyond(some)), Home: go(first), End: go(last) };
    }
    tell(chart) {
      const unit = chart.unit.replace("no unit declared", "");
      const values = chart.curves.filter((c) => !c.hidden).map((c) => `${c.label} ${chart.valueOf(c)} ${unit}`.trim());
      values.push(...chart.also.map((c) => `${c.label} ${chart.valueOf(c)}`));
      announcer.textContent = `${this.place(this.nearest)}: ${values.join(", ")}`;
    }
  }

  class ReportChart extends Chart {
    constructor(host, figure, spec) {
      const { title, unit, traces, band, levels, uprights = [], outside, reach, limit, also = [] } = spec;
      super(host, figure, { unit, levels, uprights, outside, reach, over: host.label });
      this.title = title;
      const curve = ({ y, x, upper, ...more }) => ({
        ...more,
        values: columns[y].v,
        text: columns[y].text,
        x: column(x),
        upper: column(upper),
      });
      this.axes = [{ curves: traces.map(curve), range: null }];
      const isLone = host.v.length === 1;
      for (const each of this.curves) {
        if (isLone && !each.x) Object.assign(each, { form: "dots", style: `${each.style} dots` });
        if (host.log && each.x) each.x = each.x.map(Math.log10);
      }
      this.also = also.map(([label, y]) => curve({ label, y }));
      if (band) this.band = { edges: band.edges.map((y) => columns[y].v), x: column(band.x) };
      if (host.log && this.band?.x) this.band.x = this.band.x.map(Math.log10);
      this.build();
      this.box.setAttribute("data-box", "");
      this.box.setAttribute(
        "aria-label",
        `${title}: arrow keys move the cursor from row to row, plus and minus zoom, 0 shows all`,
      );
      for (const each of this.also) {
        each.cell = make("output");
        this.legend.append(make("span", { class: "entry" }, make("span", {}, each.label), each.cell));
      }
      const note = (swatch, words) => this.legend.append(make("span", { class: "entry" }, swatch, words));
      if (band) note(make("span", { class: "swatch-band" }), band.label);
      if (outside.length) note(make("span", { class: "swatch-outside" }), "outside the logs of the model");
      if (limit) {
        const swatch = make("svg", { class: "swatch", viewBox: "0 0 22 8", "aria-hidden": "true" });
        swatch.append(make("path", { class: "limit", d: "M0 4h22" }));
        note(swatch, limit);
      }
      const name = safeName(title) || "chart";
      for (const kind of ["PNG", "SVG", "CSV"]) {
        const about = { title: `save what this chart shows as ${kind}`, "aria-label": `${title} as ${kind}` };
        const csv = () => save(new Blob([this.table()], { type: "text/csv" }), `${name}.csv`);
        const picture = () => this.saveAs(kind, name, `${title} [${unit}]`);
        this.tools.append(button(kind, kind === "CSV" ? csv : picture, about));
      }
      const enlarge = button("enlarge", () => {
        const isWide = figure.classList.toggle("wide");
        enlarge.setAttribute("aria-pressed", String(isWide));
        host.draw([this]);
      });
      this.tools.append(enlarge);
      const all = host.symbol === "t" ? "whole run" : "all";
      this.tools.append(button(all, () => host.home(), { class: "back", title: "show all of the axis again" }));
      one(".summary", figure).remove();
      one("figcaption", figure).append(this.legend);
      figure.append(this.grid);
    }
    // The points in sight, of which there are no more than the picture has columns.
    prepare() {
      const { host } = this,
        columnsSeen = Math.max(200, this.size.width);
      const of = (x, v, breaks) => extremes(x ?? host.x, v, host.view, columnsSeen, breaks);
      for (const curve of this.curves) {
        const isLine = curve.form === "line" || curve.form === "held";
        curve.points = isLine
          ? of(curve.x, curve.values, curve.anew ? host.about.breaks : [])
          : extremes(curve.x ?? host.x, curve.values, host.view, Infinity);
        if (curve.upper) {
          const { first, low } = curve.points;
          curve.points.upper = curve.upper.subarray(first, first + low.length);
        }
      }
      if (this.band) this.band.points = this.band.edges.map((edge, k) => outer(of(this.band.x, edge), k));
    }
    draw() {
      super.draw();
      this.isStale = false;
    }
    valueOf(curve) {
      const { host } = this,
        row = curve.x ? near(curve.x, host.cursor) : host.nearest,
        text = curve.items?.[curve.values[row]] ?? this.textOf(curve, row);
      return text + (curve.upper ? ` … ${curve.text(curve.upper[row])}` : "");
    }
    textOf(curve, row) {
      const value = curve.values[row];
      if (!this.host.about.points || Number.isNaN(value)) return curve.text(value);
      return String(Number(value.toPrecision(5))).replaceAll("-", MINUS);
    }
    read() {
      const { host } = this;
      put(this.when, host.text(host.nearest) + host.suffix);
      for (const curve of [...this.curves, ...this.also]) put(curve.cell, this.valueOf(curve));
      if (host.about.points && this.size) this.spot(host.cursor, this.curves[0].values[host.nearest]);
    }
    // Of points in a plane the one nearest to the pointer.
    nearestPoint(event) {
      const { x, ys } = this.scales(),
        frame = this.box.getBoundingClientRect(),
        { values } = this.curves[0];
      let [best, least] = [0, Infinity];
      for (let row = 0; row < values.length; row++) {
        const across = (frame.width * (this.host.x[row] - x.low)) / (x.high - x.low) - (event.clientX - frame.left),
          up = frame.height * (1 - (values[row] - ys[0].low) / (ys[0].high - ys[0].low)) - (event.clientY - frame.top),
          away = Math.hypot(across, up);
        if (away < least) [best, least] = [row, away];
      }
      return best;
    }
    // All rows in sight as CSV; curves with points of their own have a cell at each of them.
    table() {
      const { host } = this,
        quote = (words) => (/[",\n]/.test(words) ? `"${words.replaceAll('"', '""')}"` : words),
        shown = [...this.curves.filter((c) => !c.hidden), ...this.also],
        own = new Set(shown.flatMap((c) => [...(c.x ?? [])])),
        xs = own.size ? [...own].sort((a, b) => a - b) : host.x,
        last = Math.min(xs.length - 1, lastUpTo(xs, host.view.to) + 1);
      const titles = (c) => {
        const label = this.also.includes(c) ? c.label : `${c.label} [${this.unit}]`;
        return c.upper ? [`${c.label}, lower [${this.unit}]`, `${c.label}, upper [${this.unit}]`] : [label];
      };
      const cellsAt = (c, row) =>
        [c.values, c.upper]
          .filter(Boolean)
          .map((v) => (row === undefined || Number.isNaN(v[row]) ? "" : c.text(v[row])));
      const rows = [[this.over, ...shown.flatMap(titles)].map(quote).join(",")];
      for (let row = Math.max(0, lastUpTo(xs, host.view.from)); row <= last; row++) {
        const places = shown.map((c) => (c.x ? rowsAt(c.x, xs[row]) : [row])),
          at = host.format(host.log ? 10 ** xs[row] : xs[row]);
        for (let k = 0; k < Math.max(...places.map((some) => some.length)); k++)
          rows.push([at, ...shown.flatMap((c, n) => cellsAt(c, places[n][k]))].join(",").replaceAll(MINUS, "-"));
      }
      return rows.join("\n") + "\n";
    }
  }
  // The outer edge of a band: below its least values, above its largest.
  const outer = (points, isUpper) => (isUpper ? points : { ...points, high: points.low });
  function rowsAt(values, at) {
    const rows = [];
    for (let row = lastUpTo(values, at); row >= 0 && values[row] === at; row--) rows.unshift(row);
    return rows;
  }

  // -- the moment of the first axis ------------------------------------------------------------------
  let now = 0,
    playing = false,
    stamp = 0;
  const ends = () => [groups[0].v[0], groups[0].v.at(-1)];
  function show(t, isRead = false) {
    const [main] = groups,
      [first, last] = ends();
    now = Math.min(last, Math.max(first, t));
    const nearest = near(main.v, now);
    main.to(nearest, isRead);
    const detail = { data: { ...page, series: columns }, now, nearest, between, locate };
    document.dispatchEvent(new CustomEvent("moment", { detail }));
    if (!play) return;
    scrub.value = (1000 * (now - first)) / (last - first || 1);
    scrub.setAttribute("aria-valuetext", `${now.toFixed(2)} seconds`);
    put(one("#clock"), now.toFixed(2));
  }
  function remember() {
    if (groups.length > 1) return; // of several axes none is the page's
    try {
      history.replaceState(null, "", `#t=${groups[0].text(groups[0].nearest).replace(MINUS, "-")}`);
    } catch {
      /* some viewers forbid it; nothing is lost */
    }
  }
  function setPlaying(isOn) {
    if (playing === isOn || !play) return;
    playing = isOn;
    play.setAttribute("aria-pressed", String(isOn));
    put(one(".unseen", play), isOn ? "Pause" : "Play");
    if (!isOn) return remember();
    if (now >= ends()[1]) show(ends()[0]);
    stamp = performance.now();
    requestAnimationFrame(advance);
  }
  function advance(instant) {
    if (!playing) return;
    show(now + (Math.max(0, instant - stamp) / 1000) * Number(one("#speed").value));
    stamp = instant;
    if (now >= ends()[1]) setPlaying(false);
    else requestAnimationFrame(advance);
  }
  function jump(t, isRead = false) {
    setPlaying(false);
    show(t, isRead);
    remember();
  }
  function timeFromAddress() {
    const match = /^#t=(-?[0-9]*\.?[0-9]+(?:e-?[0-9]+)?)$/.exec(location.hash);
    return match ? Number(match[1]) : null;
  }
  // Only what has the focus takes keys, so that the page scrolls as any page.
  function onKey(event) {
    if (event.altKey || event.ctrlKey || event.metaKey || event.target.closest("select, summary, a, input:not(#scrub)"))
      return;
    if (event.key === " " && event.target.closest("button")) return; // the button does it itself
    const steps = { ArrowLeft: -0.1, ArrowRight: 0.1, PageUp: 1, PageDown: -1 };
    if (event.key === " ") setPlaying(!playing);
    else if (event.key in steps && (event.target === scrub || event.key.startsWith("Arrow")))
      jump(now + steps[event.key]);
    else if (event.target === scrub && event.key === "Home") jump(ends()[0]);
    else if (event.target === scrub && event.key === "End") jump(ends()[1]);
    else return;
    event.preventDefault();
  }

  // -- start -----------------------------------------------------------------------------------------
  const watcher = new IntersectionObserver(
    (entries) => {
      for (const { target, isIntersecting } of entries) {
        const chart = groups.flatMap((group) => group.charts).find(({ figure }) => figure === target);
        chart.isNear = isIntersecting;
        if (isIntersecting && chart.isStale) chart.host.draw([chart]);
      }
      root.dataset.ready = "yes";
    },
    { rootMargin: "300px" },
  );
  if (!page.charts?.length || !page.groups.some(({ of }) => of) || typeof DecompressionStream === "undefined") {
    root.dataset.ready = "still"; // nothing to draw
    return;
  }
  columns = await unpack();
  groups = page.groups.map((about) => new Group(about, page.groups.length < 2));
  for (const figure of all("[data-chart]")) {
    const spec = page.charts[figure.dataset.chart];
    groups[spec.group].add(figure, spec).isStale = true;
  }
  for (const group of groups) if (group.v.length && group.charts.length) group.to(group.start());
  if (play) {
    for (const element of all(".controls, .keys")) element.hidden = false;
    play.addEventListener("click", () => setPlaying(!playing));
    scrub.addEventListener("input", () => {
      setPlaying(false);
      show(ends()[0] + ((ends()[1] - ends()[0]) * Number(scrub.value)) / 1000);
    });
    scrub.addEventListener("change", remember);
    one("#player").addEventListener("keydown", onKey);
  }
  addEventListener("hashchange", () => {
    const t = timeFromAddress();
    if (t !== null) jump(t);
  });
  const resized = new ResizeObserver((entries) => {
    const boxes = new Set(entries.map(({ target }) => target));
    for (const group of groups) group.draw(group.charts.filter((chart) => chart.isNear && boxes.has(chart.box)));
  });
  for (const chart of groups.flatMap((group) => group.charts)) resized.observe(chart.box);
  document.body.classList.add("live");
  const linked = timeFromAddress();
  show(linked ?? groups[0].v[groups[0].nearest], linked !== null && groups.length < 2);
  if (!groups.some((group) => group.charts.length)) root.dataset.ready = "yes";
})();
