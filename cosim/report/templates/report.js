// Moves the cursors and the read-outs together, and tells the moment to whoever draws more. The page is complete without it.
(() => {
  "use strict";
  const data = JSON.parse(document.getElementById("run-data").textContent);
  const time = data.t;
  if (time.length < 2) return;

  const first = time[0], last = time[time.length - 1], span = last - first;
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  const one = (selector, root = document) => root.querySelector(selector);
  const play = one("#play"), scrub = one("#scrub"), speed = one("#speed"), clock = one("#clock");
  // Fixed decimals with a true minus sign, and no minus before zero.
  const fixed = (value, digits) => {
    const text = value.toFixed(digits);
    return Number(text) === 0 ? text.replace("-", "") : text.replace("-", "\u2212");
  };

  // Row at or before t, and how far t is on the way to the next row.
  function locate(t) {
    let low = 0, high = time.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (time[middle] <= t) low = middle; else high = middle;
    }
    if (t >= last) return [time.length - 1, 0];
    return [low, Math.min(1, Math.max(0, (t - time[low]) / (time[high] - time[low])))];
  }

  // Where a drawing stands between two rows; where the next row has none the last one stays. No number is shown of it.
  function between(values, row, share, held) {
    const a = values[row], b = values[row + 1];
    return a == null || b == null || held ? a : a + share * (b - a);
  }

  const cells = all("[data-key]").map((cell) => [cell, data.series[cell.dataset.key]]);
  const shown = one("#row");
  // Numbers are those of a row that was recorded, the nearest in the page, and never made up between two.
  function readOut(row) {
    for (const [cell, series] of cells) {
      const value = series.v[row];
      cell.textContent = value == null ? "\u2013" : fixed(value, series.d);
    }
    if (!shown || !cells.length) return;
    shown.hidden = false;
    shown.textContent = `numbers: row ${data.row[row]} of ${data.of}, t = ${time[row]} s`
      + (data.of > time.length ? `; ${time.length} of the rows are in this page, all are in results.csv` : "");
  }

  let now = last, playing = false, stamp = 0;
  // The plots' axis is exactly the run, so one share of the width serves them all.
  function show(t) {
    now = Math.min(last, Math.max(first, t));
    const [row, share] = locate(now), along = (now - first) / span;
    document.documentElement.style.setProperty("--cursor", (100 * along).toFixed(3) + "%");
    const nearest = share < 0.5 ? row : row + 1;
    readOut(nearest);
    document.dispatchEvent(new CustomEvent("moment", { detail: { data, row, share, nearest, between, fixed } }));
    if (!play) return;
    scrub.value = 1000 * along;
    scrub.setAttribute("aria-valuetext", now.toFixed(2) + " seconds");
    clock.textContent = now.toFixed(2);
  }

  function remember() {
    try { history.replaceState(null, "", "#t=" + now.toFixed(2)); } catch { /* some viewers forbid it; nothing is lost */ }
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
    const found = /^#t=(-?[0-9]*\.?[0-9]+)$/.exec(location.hash);
    return found ? Number(found[1]) : null;
  }

  function listenToPlots() {
    for (const box of all("[data-scrub]")) {
      const seek = (event) => {
        const frame = box.getBoundingClientRect();
        setPlaying(false);
        show(first + span * (event.clientX - frame.left) / frame.width);
      };
      box.addEventListener("pointerdown", (event) => { box.setPointerCapture(event.pointerId); seek(event); });
      box.addEventListener("pointermove", (event) => { if (box.hasPointerCapture(event.pointerId)) seek(event); });
      box.addEventListener("pointerup", remember);
    }
  }

  function onKey(event) {
    if (event.altKey || event.ctrlKey || event.metaKey || event.target.closest("select, summary, a, input:not(#scrub)")) return;
    if (event.key === " " && event.target.closest("button")) return; // the button does it itself
    const steps = { ArrowLeft: -0.1, ArrowRight: 0.1, PageUp: 1, PageDown: -1 };
    if (event.key === " ") setPlaying(!playing);
    else if (event.key === "ArrowLeft" || event.key === "ArrowRight") jump(now + steps[event.key]);
    else if (event.target === scrub && event.key in steps) jump(now + steps[event.key]);
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
    document.addEventListener("keydown", onKey);
    window.addEventListener("hashchange", () => { const t = timeFromAddress(); if (t != null) { setPlaying(false); show(t); } });
  }
  document.body.classList.add("live");
  listenToPlots();
  const asked = timeFromAddress();
  show(asked == null ? last : asked);
})();
