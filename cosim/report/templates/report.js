// Unpacks the rows, moves the cursors and the read-outs together, and tells the moment to whoever draws more.
// The page is complete without it.
(async () => {
  "use strict";
  const packed = JSON.parse(document.getElementById("run-data").textContent);
  if (packed.rows < 2 || typeof DecompressionStream === "undefined") return;
  const data = await unpack(packed);
  const time = data.t, count = time.length;

  const first = time[0], last = time[count - 1], span = last - first;
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  const one = (selector, root = document) => root.querySelector(selector);
  const play = one("#play"), scrub = one("#scrub"), speed = one("#speed"), clock = one("#clock");
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
      const values = new Float64Array(rows), scale = 10 ** Math.abs(power);
      for (let k = 0, sum = 0; k < rows; k++) {
        let z = 0, unit = 1, byte;
        do { byte = raw[at++]; z += (byte & 127) * unit; unit *= 128; } while (byte > 127);
        sum += z % 2 ? -(z + 1) / 2 : z / 2;
        values[k] = power < 0 ? sum * scale : sum / scale;
      }
      return values;
    }
    const t = column(p), found = {};
    for (const [key, entry] of Object.entries(series)) {
      const v = column(entry.p);
      if (entry.g) column(0).forEach((there, k) => { if (!there) v[k] = NaN; });
      found[key] = { v, p: entry.p, held: entry.h, text: textOf(v, entry.p) };
    }
    return { ...more, t, p, series: found };
  }

  // A value as it stands on its grid: all decimals it has, or an exponent where these would be too many.
  function textOf(values, power) {
    let largest = 0;
    for (const v of values) if (Math.abs(v) > largest) largest = Math.abs(v);
    const lead = largest > 0 ? Math.floor(Math.log10(largest)) : 0;
    const plain = power <= 7 && lead < 9;
    return (v) => (Number.isNaN(v) ? "\u2013" : plain ? fixed(v, Math.max(0, power))
      : v === 0 ? "0" : v.toExponential(Math.max(0, Math.min(20, Math.floor(Math.log10(Math.abs(v))) + power))).replace("-", "\u2212").replace("e-", "e\u2212"));
  }
  const timeText = (row) => String(Number(time[row].toFixed(Math.max(0, packed.p)))).replace("-", "\u2212");

  // Row at or before t, and how far t is on the way to the next row.
  function locate(t, times = time) {
    let low = 0, high = times.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (times[middle] <= t) low = middle; else high = middle;
    }
    if (t >= times[times.length - 1]) return [times.length - 1, 0];
    return [low, Math.min(1, Math.max(0, (t - times[low]) / (times[high] - times[low])))];
  }

  // Where a drawing stands between two rows; where the next row has none the last one stays. No number is shown of it.
  function between(values, row, share, held) {
    const a = values[row], b = values[row + 1];
    return a == null || b == null || held ? a : a + share * (b - a);
  }

  const cells = all("[data-key]").map((cell) => [cell, data.series[cell.dataset.key]]);
  const shown = one("#row"), tags = all(".when");
  // Numbers are those of a row that was recorded, and never made up between two.
  function readOut(row) {
    for (const [cell, series] of cells) cell.textContent = series.text(series.v[row]);
    for (const tag of tags) tag.textContent = timeText(row) + " s";
    if (!shown || !cells.length) return;
    shown.hidden = false;
    shown.textContent = `numbers: row ${Math.min(data.of, 1 + row * data.every)} of ${data.of}, t = ${timeText(row)} s`
      + (data.of > count ? `; ${count} of the rows are in this page, all are in results.csv` : "");
  }

  let now = last, nearest = count - 1, playing = false, stamp = 0, view = { from: first, to: last };
  function place() {
    const along = (time[nearest] - view.from) / (view.to - view.from), root = document.documentElement;
    root.style.setProperty("--cursor", (100 * along).toFixed(3) + "%");
    root.classList.toggle("cursor-away", along < -1e-9 || along > 1 + 1e-9);
    root.classList.toggle("cursor-late", along > 0.8);
  }

  function show(t) {
    now = Math.min(last, Math.max(first, t));
    const [row, share] = locate(now);
    nearest = share < 0.5 ? row : row + 1;
    readOut(nearest);
    place();
    document.dispatchEvent(new CustomEvent("moment", { detail: { data, now, nearest, between, fixed, locate } }));
    if (!play) return;
    scrub.value = 1000 * (now - first) / span;
    scrub.setAttribute("aria-valuetext", now.toFixed(2) + " seconds");
    clock.textContent = now.toFixed(2);
  }

  function remember() {
    try { history.replaceState(null, "", "#t=" + timeText(nearest).replace("\u2212", "-")); } catch { /* some viewers forbid it; nothing is lost */ }
  }

  function setPlaying(on) {
    if (playing === on || !play) return;
    playing = on;
    play.setAttribute("aria-pressed", String(on));
    one(".unseen", play).textContent = on ? "Pause" : "Play";
    if (!on) { remember(); return; }
    if (now >= last) show(first);
    stamp = performance.now();
    requestAnimationFrame(advance);
  }

  function advance(instant) {
    if (!playing) return;
    show(now + Math.max(0, instant - stamp) / 1000 * Number(speed.value));
    stamp = instant;
    if (now >= last) setPlaying(false); else requestAnimationFrame(advance);
  }

  function jump(t) { setPlaying(false); show(t); remember(); }

  function timeFromAddress() {
    const found = /^#t=(-?[0-9]*\.?[0-9]+(?:e-?[0-9]+)?)$/.exec(location.hash);
    return found ? Number(found[1]) : null;
  }

  // Only what has the focus takes keys, so that the page scrolls as any page.
  function onKey(event) {
    if (event.altKey || event.ctrlKey || event.metaKey || event.target.closest("select, summary, a, input:not(#scrub)")) return;
    if (event.key === " " && event.target.closest("button")) return; // the button does it itself
    const steps = { ArrowLeft: -0.1, ArrowRight: 0.1, PageUp: 1, PageDown: -1 };
    if (event.key === " ") setPlaying(!playing);
    else if (event.key in steps && (event.target === scrub || event.key.startsWith("Arrow"))) jump(now + steps[event.key]);
    else if (event.target === scrub && event.key === "Home") jump(first);
    else if (event.target === scrub && event.key === "End") jump(last);
    else return;
    event.preventDefault();
  }

  if (play) {
    for (const element of all(".controls, .keys")) element.hidden = false;
    play.addEventListener("click", () => setPlaying(!playing));
    scrub.addEventListener("input", () => { setPlaying(false); show(first + span * Number(scrub.value) / 1000); });
    scrub.addEventListener("change", remember);
    one("#player").addEventListener("keydown", onKey);
  }
  window.addEventListener("hashchange", () => { const t = timeFromAddress(); if (t != null) jump(t); });
  document.body.classList.add("live");
  const asked = timeFromAddress();
  document.dispatchEvent(new CustomEvent("rows", { detail: {
    data, fixed, locate, timeText,
    at: () => nearest,
    seek: (row) => { if (!playing) show(time[row]); },
    settle: (row) => jump(time[row]),
    look: (from, to) => { view = { from, to }; place(); },
  } }));
  show(asked == null ? last : asked);
  document.documentElement.dataset.ready = "yes";
})();
