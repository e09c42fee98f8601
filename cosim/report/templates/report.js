// Unpacks the rows, moves cursors and read-outs of each axis together, tells the moment to whoever draws more.
// The page is complete without it.
(async () => {
  "use strict";
  const page = JSON.parse(document.getElementById("run-data").textContent);
  const packed = [page, ...(page.further ?? [])].filter((block) => block.rows > 1 || (block.rows && block.points));
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  const one = (selector, root = document) => root.querySelector(selector);
  scrollable();
  // Paper shows what is folded up.
  const unfolded = [];
  window.addEventListener("beforeprint", () => {
    for (const part of all("details:not([open])")) {
      part.open = true;
      unfolded.push(part);
    }
  });
  window.addEventListener("afterprint", () => {
    for (const part of unfolded.splice(0)) part.open = false;
  });
  if (!packed.length || typeof DecompressionStream === "undefined") {
    document.documentElement.dataset.ready = "still"; // nothing to move in
    return;
  }
  const play = one("#play"),
    scrub = one("#scrub"),
    speed = one("#speed"),
    clock = one("#clock");
  // A table or a command that is wider than the page is scrolled by keys too.
  function scrollable() {
    for (const box of all(".scroll:not([tabindex]), pre")) {
      const fit = () => {
        const wide = box.scrollWidth > box.clientWidth + 1;
        for (const [name, value] of [
          ["tabindex", "0"],
          ["role", "region"],
          ["aria-label", one("caption", box)?.textContent.trim() || (box.matches("pre") ? "Command" : "Table")],
        ]) {
          if (wide) box.setAttribute(name, value);
          else box.removeAttribute(name);
        }
      };
      new ResizeObserver(fit).observe(box);
      fit();
    }
  }

  // Fixed decimals with a true minus sign, and no minus before zero.
  const fixed = (value, digits) => {
    const text = value.toFixed(digits);
    return Number(text) === 0 ? text.replace("-", "") : text.replace("-", "\u2212");
  };

  // What packed.py wrote: differences as zigzag numbers of seven bits a byte, a column behind the other; where one has
  // gaps, a column of 0 and 1 follows it.
  async function unpack({ packed: text, series, rows, p, ...more }) {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    const raw = new Uint8Array(await new Response(stream).arrayBuffer());
    let at = 0;
    function column(power) {
      const values = new Float64Array(rows),
        scale = 10 ** Math.abs(power);
      for (let k = 0, sum = 0; k < rows; k++) {
        let z = 0,
          unit = 1,
          byte;
        do {
          byte = raw[at++];
          z += (byte & 127) * unit;
          unit *= 128;
        } while (byte > 127);
        sum += z % 2 ? -(z + 1) / 2 : z / 2;
        values[k] = power < 0 ? sum * scale : sum / scale;
      }
      return values;
    }
    const t = column(p),
      signals = {};
    for (const [key, entry] of Object.entries(series)) {
      const v = column(entry.p);
      if (entry.g)
        column(0).forEach((isPresent, k) => {
          if (!isPresent) v[k] = NaN;
        });
      signals[key] = {
        v,
        way: entry.h,
        anew: entry.b,
        shift: entry.s ?? 0,
        upper: entry.u,
        items: entry.i,
        text: textOf(v, entry.p),
      };
    }
    for (const signal of Object.values(signals)) signal.upper = signals[signal.upper]?.v;
    return { over: ["time", "s"], ...more, t, p, series: signals };
  }

  // A value as it stands on its grid: all decimals it has, or an exponent where these would be too many.
  function textOf(values, power) {
    let largest = 0;
    for (const v of values) if (Math.abs(v) > largest) largest = Math.abs(v);
    const lead = largest > 0 ? Math.floor(Math.log10(largest)) : 0;
    const plain = lead < 9 && (power <= 7 || (lead >= 0 && power <= 12));
    return (v) =>
      Number.isNaN(v)
        ? "\u2013"
        : plain
          ? fixed(v, Math.max(0, power))
          : v === 0
            ? "0"
            : v
                .toExponential(Math.max(0, Math.min(20, Math.floor(Math.log10(Math.abs(v))) + power)))
                .replace("-", "\u2212")
                .replace("e-", "e\u2212");
  }
  // Row at or before t, and how far t is on the way to the next row.
  function locateIn(t, times) {
    let low = 0,
      high = times.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (times[middle] <= t) low = middle;
      else high = middle;
    }
    if (t >= times[times.length - 1]) return [times.length - 1, 0];
    return [low, Math.min(1, Math.max(0, (t - times[low]) / (times[high] - times[low] || 1)))];
  }

  // Where a drawing stands between two rows; where the next row has none the last one stays. No number is shown of it.
  function between(values, row, share, held) {
    const a = values[row],
      b = values[row + 1];
    return a == null || b == null || held ? a : a + share * (b - a);
  }

  // One axis: its rows, the charts over it, what is looked at and where the cursor is. Numbers are those of a row that
  // was recorded, and never made up between two; of a chart whose curves have points of their own, those nearest.
  const rowNote = one("#row");
  class Axis {
    constructor(data, alone) {
      const { t } = data,
        count = t.length,
        [name, unit] = data.over;
      this.data = data;
      this.time = t;
      this.nearest = count - 1;
      this.moved = [];
      if (!alone) {
        // begin where something can be read
        const every = Object.values(data.series),
          read = (row) => data.sparse || every.every(({ v }) => !Number.isNaN(v[row]));
        while (this.nearest > 0 && !read(this.nearest)) this.nearest--;
        if (!read(this.nearest)) this.nearest = count - 1;
      }
      const [first, last] = (this.ends = data.ends ?? [t[0], t[count - 1]]);
      this.view = { from: first, to: last };
      this.figures = all("[data-chart]").filter((figure) => one("[data-line]", figure)?.dataset.line in data.series);
      this.hosts = alone ? [document.documentElement] : this.figures;
      this.cells = all("[data-key]")
        .filter((cell) => cell.dataset.key in data.series)
        .map((cell) => [cell, data.series[cell.dataset.key]]);
      this.tags = alone ? all(".when") : this.figures.map((figure) => one(".when", figure));
      this.symbol = name === "time" ? "t" : name;
      this.unit = unit === "1" ? "" : ` ${unit}`;
    }

    text(row) {
      const { p, sparse, over, log } = this.data,
        value = log ? 10 ** this.time[row] : this.time[row],
        time = over[0] === "time" && !sparse;
      return String(Number(time ? value.toFixed(Math.max(0, p)) : value.toPrecision(5))).replace("-", "\u2212");
    }
    place(row) {
      return `${this.symbol} = ${this.text(row)}${this.unit}`;
    }
    locate(t) {
      return locateIn(t, this.time);
    }
    near(t) {
      const [row, share] = this.locate(t);
      return share < 0.5 ? row : row + 1;
    }

    // What a signal has at a row; of points of its own, at the one nearest to it.
    read(series, row) {
      let at = row;
      if (this.data.points)
        return Number.isNaN(series.v[row])
          ? "\u2013"
          : String(Number(series.v[row].toPrecision(5))).replaceAll("-", "\u2212");
      if (this.data.sparse && Number.isNaN(series.v[row])) {
        let before = row,
          after = row;
        while (before >= 0 && Number.isNaN(series.v[before])) before--;
        while (after < this.time.length && Number.isNaN(series.v[after])) after++;
        at =
          before < 0
            ? after
            : after >= this.time.length
              ? before
              : this.time[row] - this.time[before] <= this.time[after] - this.time[row]
                ? before
                : after;
      }
      return (
        (series.items?.[series.v[at]] ?? series.text(series.v[at])) +
        (series.upper ? ` \u2026 ${series.text(series.upper[at])}` : "")
      );
    }

    mark() {
      const along = (this.time[this.nearest] - this.view.from) / (this.view.to - this.view.from);
      for (const host of this.hosts) {
        host.style.setProperty("--cursor", (100 * along).toFixed(3) + "%");
        host.classList.toggle("cursor-away", along < -1e-9 || along > 1 + 1e-9);
        host.classList.toggle("cursor-late", along > 0.8);
      }
      for (const tell of this.moved) tell();
    }

    // tell: name the row at the foot of the page, while a chart is read
    to(row, tell = false) {
      this.nearest = row;
      for (const [cell, series] of this.cells) cell.textContent = this.read(series, row);
      for (const tag of this.tags) tag.textContent = this.text(row) + this.unit;
      this.mark();
      if (!tell || !rowNote || !this.cells.length) return;
      const { of, every, sparse } = this.data,
        count = this.time.length;
      rowNote.hidden = false;
      rowNote.textContent = this.data.points
        ? `numbers: point ${row + 1} of ${count}, ${this.place(row)}`
        : sparse
          ? `numbers: of each curve its point nearest to ${this.place(row)}`
          : `numbers: row ${Math.min(of, 1 + row * every)} of ${of}, ${this.place(row)}` +
            (of > count ? `; ${count} of the rows are in this page, all are in results.csv` : "");
    }
  }

  const blocks = await Promise.all(packed.map(unpack)),
    axes = blocks.map((data) => new Axis(data, blocks.length < 2));
  const main = axes[0],
    { data, time } = main,
    first = time[0],
    last = time[time.length - 1],
    span = last - first || 1;
  const locate = (t, times = time) => locateIn(t, times),
    timeText = (row) => main.text(row);
  let now = last,
    playing = false,
    stamp = 0;

  function show(t, tell = false) {
    now = Math.min(last, Math.max(first, t));
    const nearest = main.near(now);
    main.to(nearest, tell);
    document.dispatchEvent(new CustomEvent("moment", { detail: { data, now, nearest, between, fixed, locate } }));
    if (!play) return;
    scrub.value = (1000 * (now - first)) / span;
    scrub.setAttribute("aria-valuetext", now.toFixed(2) + " seconds");
    clock.textContent = now.toFixed(2);
  }

  function remember() {
    if (axes.length > 1) return; // of several axes none is the page's
    try {
      history.replaceState(null, "", "#t=" + timeText(main.nearest).replace("\u2212", "-"));
    } catch {
      /* some viewers forbid it; nothing is lost */
    }
  }

  function setPlaying(on) {
    if (playing === on || !play) return;
    playing = on;
    play.setAttribute("aria-pressed", String(on));
    one(".unseen", play).textContent = on ? "Pause" : "Play";
    if (!on) {
      remember();
      return;
    }
    if (now >= last) show(first);
    stamp = performance.now();
    requestAnimationFrame(advance);
  }

  function advance(instant) {
    if (!playing) return;
    show(now + (Math.max(0, instant - stamp) / 1000) * Number(speed.value));
    stamp = instant;
    if (now >= last) setPlaying(false);
    else requestAnimationFrame(advance);
  }

  function jump(t, tell = false) {
    setPlaying(false);
    show(t, tell);
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
    else if (event.target === scrub && event.key === "Home") jump(first);
    else if (event.target === scrub && event.key === "End") jump(last);
    else return;
    event.preventDefault();
  }

  if (play) {
    for (const element of all(".controls, .keys")) element.hidden = false;
    play.addEventListener("click", () => setPlaying(!playing));
    scrub.addEventListener("input", () => {
      setPlaying(false);
      show(first + (span * Number(scrub.value)) / 1000);
    });
    scrub.addEventListener("change", remember);
    one("#player").addEventListener("keydown", onKey);
  }
  window.addEventListener("hashchange", () => {
    const t = timeFromAddress();
    if (t != null) jump(t);
  });
  document.body.classList.add("live");
  const linkedTime = timeFromAddress();
  for (const axis of axes) {
    const ours = axis === main;
    document.dispatchEvent(
      new CustomEvent("rows", {
        detail: {
          axis,
          data: axis.data,
          figures: axis.figures,
          locate: (t) => axis.locate(t),
          read: (series, row) => axis.read(series, row),
          at: () => axis.nearest,
          seek: (row) => {
            if (!ours || !play) axis.to(row, true);
            else if (!playing) show(time[row], true);
          },
          settle: (row) => {
            if (ours && play) jump(time[row], true);
            else {
              axis.to(row, true);
              if (ours) remember();
            }
          },
          rest: () => {
            if (rowNote) rowNote.hidden = true;
          },
          look: (from, to) => {
            axis.view = { from, to };
            axis.mark();
          },
        },
      }),
    );
    if (!ours) axis.to(axis.nearest);
  }
  show(linkedTime == null ? time[main.nearest] : linkedTime, linkedTime != null && axes.length < 2);
  document.documentElement.dataset.ready = "yes";
})();
