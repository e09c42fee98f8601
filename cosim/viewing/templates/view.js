// The signal browser: plots over one time, points from the server for what is in sight, layouts, derived signals.
/* global one, all, make, put, readable, post, request, save, savePng, safeName, SignalTree, SignalPlot */
(async () => {
  "use strict";
  const MOST_DROPPED = 24, // signals of a group that are added at once
    LATE = 150, // [ms] until many points are drawn as they are here, if the answer has not come
    QUICK = 2000, // points; more are painted as pixels, once, when the answer comes
    DENSE = 24, // curves; more are painted as pixels, of half as many columns
    LEAST = 1e-9; // of the whole time: the shortest view
  const paper = matchMedia("print");
  const READY = ["a - b", "a + b", "a * b", "a / b", "der(a)", "integral(a)", "lowpass(a, 1)", "abs(a)", "hypot(a, b)"];
  const about = await (await fetch("about")).json();
  const lists = new Map(); // one for the runs of a set, so that they share a tree
  function allNames(set) {
    const [numbers, , texts] = about.sets[set];
    if (!lists.has(set)) lists.set(set, [...new Set([...numbers, ...texts])]);
    return lists.get(set);
  }
  const runs = about.runs.map((run) => {
    const [numbers, units, texts] = about.sets[run.set];
    const own = Object.create(null),
      kinds = Object.create(null);
    numbers.forEach((name, k) => (own[name] = units[k]));
    for (const name of texts) {
      kinds[name] = name in own ? "whole" : "text"; // integers that doubles may round are numbers and texts
      own[name] ??= "";
    }
    for (const { name, unit } of run.derived) own[name] = unit;
    const [short] = run.label.split(" (");
    const isOne = about.runs.filter(({ label }) => label.split(" (")[0] === short).length === 1;
    return {
      ...run,
      short: isOne ? short : run.label,
      names: texts.length ? allNames(run.set) : numbers,
      units: own,
      kinds,
      formulas: run.derived,
      derived: run.derived.map(({ name }) => name),
    };
  });
  const whole = { from: Math.min(...runs.map((r) => r.from)), to: Math.max(...runs.map((r) => r.to)) };
  if (!(whole.to > whole.from)) whole.to = whole.from + 1;
  let layouts = about.layouts;
  const tell = (words) => put(one("#told"), words);
  const told = [...about.notes];
  const warn = (words) => {
    if (words && !told.includes(words)) told.push(words);
    one("#message").hidden = !told.length;
    put(one("#message"), told.join(" · "));
  };
  warn("");

  const desk = {
    runs,
    plots: [],
    view: { ...whole },
    cursor: null,
    pin: null,
    dragged: null,
    active: null,

    // -- plots ------------------------------------------------------------------------------------
    addPlot(kind, after = null) {
      const plot = new SignalPlot(desk, kind);
      desk.plots.splice(after ? desk.plots.indexOf(after) + 1 : desk.plots.length, 0, plot);
      one("#plots").insertBefore(plot.figure, after ? after.figure.nextSibling : null);
      watcher.observe(plot.figure);
      listen(plot);
      desk.mark(plot);
      for (const each of desk.plots) each.build();
      return plot;
    },
    remove(plot) {
      const before = desk.extent;
      plot.figure.remove();
      desk.plots = desk.plots.filter((each) => each !== plot);
      if (!desk.plots.length) desk.addPlot("time");
      if (desk.active === plot) desk.mark(desk.plots[0]);
      for (const each of desk.plots) each.build();
      desk.follow(before);
    },
    mark(plot) {
      desk.active = plot;
      for (const each of desk.plots) {
        each.figure.classList.toggle("active", each === plot && desk.plots.length > 1);
        each.title.setAttribute("aria-pressed", String(each === plot));
      }
    },
    add(curves, plot, place = null) {
      const some = curves.slice(0, MOST_DROPPED),
        before = desk.extent;
      plot.add(some, place);
      desk.follow(before);
      desk.mark(plot);
      const rest = curves.length - some.length;
      const what = some.length === 1 ? some[0][1] : `${some.length} signals`;
      tell(`${what} in ${plot.name}${rest ? `; ${rest} more left out` : ""}`);
    },
    // All boxes have one width, so that one time is at one place.
    changed() {
      const right = Math.max(1, ...desk.plots.map((plot) => plot.axes.length)) - 1;
      one("#plots").style.setProperty("--right", right ? `repeat(${right}, 66px)` : "");
      schedule();
    },

    get curves() {
      return desk.plots.filter(({ kind }) => kind === "time").flatMap((plot) => plot.curves);
    },
    get isDense() {
      return !paper.matches && desk.curves.length > DENSE;
    },
    // A browser strokes paths of many points in tenths of a second.
    get isPainted() {
      const points = desk.curves.reduce((sum, { data }) => sum + (data?.t.length ?? 0), 0);
      return desk.isDense || (!paper.matches && points > QUICK);
    },

    // Run, formula and notes of a curve.
    about({ run, name }) {
      const { label, formulas, kinds } = runs[run],
        made = formulas.find((f) => f.name === name);
      if (kinds[name] === "text") return `${label}\nTexts are not drawn; the cursor shows them.`;
      if (!made) return label;
      const of = (r, signal) => (r === run ? signal : `${signal} of ${runs[r].short}`),
        parts = Object.entries(made.of).map(([letter, [r, signal]]) => `${letter}: ${of(r, signal)}`);
      return [label, `${made.formula} with ${parts.join(", ")}`, ...made.notes].join("\n");
    },

    // Paper has no hints: it lists the runs that are drawn.
    listRuns() {
      const drawn = [...new Set(desk.plots.flatMap((plot) => plot.curves.map((c) => c.run)))].sort((a, b) => a - b);
      const lines = drawn.map((run) => make("li", {}, `${runs[run].label}: ${runs[run].file}`));
      one("#paper-runs").replaceChildren(...lines);
    },

    // -- view and cursor ----------------------------------------------------------------------------
    look(from, to) {
      const least = LEAST * (whole.to - whole.from),
        width = Math.max(least, Math.min(to - from, whole.to - whole.from)),
        middle = (from + to) / 2;
      const start = Math.max(whole.from, Math.min(whole.to - width, middle - width / 2));
      desk.view = { from: start, to: start + width };
      one("#from").value = +desk.view.from.toPrecision(9);
      one("#to").value = +desk.view.to.toPrecision(9);
      for (const plot of desk.plots) plot.fresh = false;
      schedule();
    },
    // The time of the runs that are drawn: a short run beside a long one that is not drawn keeps its width.
    get extent() {
      const drawn = new Set(desk.plots.flatMap((plot) => plot.curves.map((c) => c.run))),
        some = [...drawn].map((run) => runs[run]);
      const from = Math.min(...some.map((r) => r.from)),
        to = Math.max(...some.map((r) => r.to));
      return to > from ? { from, to } : { ...whole };
    },
    follow(before) {
      const { from, to } = desk.extent;
      const isNear = (one, other) => Math.abs(one - other) <= LEAST * (before.to - before.from);
      if (isNear(desk.view.from, before.from) && isNear(desk.view.to, before.to)) desk.look(from, to); // not zoomed
    },
    home() {
      for (const each of desk.plots.flatMap((plot) => plot.axes)) each.range = null;
      const { from, to } = desk.extent;
      desk.look(from, to);
    },
    zoom(factor, about) {
      const { from, to } = desk.view;
      desk.look(about - (about - from) * factor, about + (to - about) * factor);
    },
    seek(time) {
      desk.cursor = time;
      const { from, to } = desk.view,
        share = time === null ? 0 : (time - from) / (to - from);
      one("#charts").classList.toggle("reading", time !== null);
      one("#charts").classList.toggle("cursor-late", share > 0.8);
      one("#charts").style.setProperty("--cursor", `${(100 * share).toFixed(3)}%`);
      for (const when of all(".when", one("#plots"))) put(when, time === null ? "" : `${readable(time)} s`);
      for (const plot of desk.plots) plot.read();
      fetchValues();
    },

    // -- files -----------------------------------------------------------------------------------------
    async export(plot, kind) {
      const name = safeName(plot.curves.map((c) => c.name).join(" ") || plot.name);
      if (kind !== "CSV") {
        const curves = plot.curves.filter((c) => c.kind !== "text"),
          before = curves.map((c) => c.data); // a narrow page has fewer columns than the picture
        if (plot.kind === "time") await fill("points", { ...desk.view, width: 1600 }, curves).catch(() => {});
        const picture = plot.picture();
        curves.forEach((c, k) => (c.data = before[k]));
        if (kind === "SVG") save(new Blob([picture], { type: "image/svg+xml" }), `${name}.svg`);
        else savePng(picture, `${name}.png`);
        return;
      }
      const curves = plot.curves.map((c) => [c.run, c.name]);
      if (plot.across) curves.unshift([plot.across.run, plot.across.name]);
      const of = JSON.stringify({ ...desk.view, curves });
      const link = make("a", { href: `export.csv?${new URLSearchParams({ of })}`, download: `${name}.csv` });
      link.click();
    },
  };

  // -- points and values from the server -----------------------------------------------------------------
  let waiting = false,
    late = 0,
    busy = false,
    again = false;
  const seen = new Map(); // figure → whether it is near the window; a new one is not here yet
  const watcher = new IntersectionObserver(
    (entries) => {
      for (const { target, isIntersecting } of entries) seen.set(target, isIntersecting);
      schedule();
    },
    { rootMargin: "300px" },
  );
  function schedule() {
    document.documentElement.dataset.view = "asked";
    queueMicrotask(fetchPoints);
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      const shown = desk.plots.filter((plot) => seen.get(plot.figure));
      clearTimeout(late);
      if (busy && desk.isPainted) late = setTimeout(draw, LATE, shown);
      else draw(shown); // what is here, until more is
    });
  }
  function draw(plots) {
    for (const plot of plots) plot.measure();
    for (const plot of plots) plot.draw();
  }
  async function fetchPoints() {
    if (busy) {
      again = true;
      return;
    }
    const plots = desk.plots.filter((plot) => seen.get(plot.figure) && !plot.fresh && plot.curves.length);
    if (!plots.length) {
      if (desk.plots.every((plot) => seen.has(plot.figure))) document.documentElement.dataset.view = "drawn";
      return;
    }
    document.documentElement.dataset.view = "fetching";
    busy = true;
    again = false;
    for (const plot of plots) plot.fresh = true;
    try {
      const shown = (kind) =>
        plots
          .filter((p) => p.kind === kind)
          .flatMap((plot) => plot.curves.filter((c) => c.kind !== "text").map((c) => ({ plot, c })));
      const columns = (plots[0].box.clientWidth || 800) / (desk.isDense ? 2 : 1),
        width = Math.max(200, Math.round(columns)),
        range = { ...desk.view };
      await fill(
        "points",
        { ...range, width },
        shown("time").map(({ c }) => c),
      );
      const planes = shown("xy");
      const across = planes.map(({ plot, c }) => [c.run, plot.across.name]);
      await fill(
        "plane",
        { ...range, width: 8000, across },
        planes.map(({ c }) => c),
      );
    } catch (error) {
      warn(
        error.message === "Failed to fetch"
          ? "The command does not answer. What it has sent stays on this page."
          : error.message,
      );
    } finally {
      busy = false;
    }
    clearTimeout(late);
    draw(plots);
    if (again || desk.plots.some((plot) => seen.get(plot.figure) && !plot.fresh && plot.curves.length)) fetchPoints();
    else if (desk.plots.every((plot) => seen.has(plot.figure))) document.documentElement.dataset.view = "drawn";
  }
  async function fill(path, asked, curves) {
    if (!curves.length) return;
    const answer = await request(path, { ...asked, curves: curves.map((c) => [c.run, c.name]) });
    const numbers = new Float64Array(await answer.arrayBuffer());
    let at = 0;
    const part = (length) => numbers.subarray(at, (at += length)),
      times = new Map(); // of each run
    for (const curve of curves) {
      const [count, more] = part(2);
      curve.lost = count < 0;
      if (curve.lost) continue; // what is drawn of it stays
      if (path === "plane" || part(1)[0]) times.set(curve.run, part(count));
      const t = times.get(curve.run);
      if (path === "plane") {
        const x = part(count),
          y = part(count);
        curve.data = { t, x, low: y, high: y, isRow: more === 1, every: more };
      } else {
        const low = part(count);
        curve.data = { t, low, high: more ? low : part(count), isRow: more === 1 };
      }
    }
  }
  // Colours change, and paper takes lines in place of pixels.
  for (const media of [paper, matchMedia("(prefers-color-scheme: dark)")])
    media.addEventListener("change", () => {
      draw(desk.plots.filter((plot) => seen.get(plot.figure)));
    });
  let reading = false;
  async function fetchValues() {
    if (reading || desk.cursor === null) return;
    const at = desk.cursor,
      shown = desk.plots.filter((plot) => seen.get(plot.figure)).flatMap((plot) => plot.curves),
      curves = shown.filter(({ kind }) => kind !== "text"),
      exact = shown.filter(({ kind }) => kind);
    if (!shown.length) return;
    reading = true;
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
      reading = false;
    }
    for (const plot of desk.plots) plot.read();
    if (desk.cursor !== at) fetchValues();
  }

  // -- pointer and keys ----------------------------------------------------------------------------------
  function listen(plot) {
    const { box } = plot;
    let start = null,
      mark = null,
      pan = null;
    const share = (event) => {
      const frame = box.getBoundingClientRect();
      return Math.max(0, Math.min(1, (event.clientX - frame.left) / frame.width));
    };
    const timeAt = (s) => desk.view.from + s * (desk.view.to - desk.view.from);
    const isTime = plot.kind === "time";
    const unmark = () => {
      mark?.remove();
      start = mark = pan = null;
    };
    box.addEventListener("pointerdown", (event) => {
      if (!isTime || (event.button && event.button !== 1) || event.pointerType === "touch") return;
      box.setPointerCapture(event.pointerId);
      if (event.button === 1 || event.shiftKey) pan = { at: share(event), ...desk.view };
      else start = share(event);
      event.preventDefault();
      box.focus({ preventScroll: true });
    });
    box.addEventListener("pointermove", (event) => {
      if (!isTime) return;
      const now = share(event);
      if (pan) {
        const shift = (pan.at - now) * (pan.to - pan.from);
        desk.look(pan.from + shift, pan.to + shift);
        return;
      }
      desk.seek(timeAt(now));
      if (start === null || Math.abs(now - start) * box.clientWidth < 5) return;
      mark ??= box.appendChild(make("span", { class: "marked", "aria-hidden": "true" }));
      mark.style.left = `${100 * Math.min(start, now)}%`;
      mark.style.width = `${100 * Math.abs(now - start)}%`;
    });
    box.addEventListener("pointerup", (event) => {
      const now = share(event);
      if (mark) desk.look(...[timeAt(start), timeAt(now)].sort((a, b) => a - b));
      else if (start !== null) setPin(timeAt(now));
      unmark();
    });
    box.addEventListener("pointercancel", unmark);
    box.addEventListener("pointerleave", () => desk.seek(null));
    box.addEventListener("blur", () => desk.seek(null));
    box.addEventListener("dblclick", desk.home);
    box.addEventListener(
      "wheel",
      (event) => {
        if (!isTime) return;
        event.preventDefault();
        desk.zoom(event.deltaY > 0 ? 1.25 : 0.8, timeAt(share(event)));
      },
      { passive: false },
    );
    box.addEventListener("keydown", (event) => onKey(event, plot));
    plot.grid.addEventListener(
      "wheel",
      (event) => {
        const place = event.target.closest("[data-axis]")?.dataset.axis;
        if (place === undefined) return;
        event.preventDefault();
        stretch(plot.axes[place], plot, event.deltaY > 0 ? 1.25 : 0.8);
      },
      { passive: false },
    );
    plot.grid.addEventListener("dblclick", (event) => {
      const place = event.target.closest("[data-axis]")?.dataset.axis;
      if (place === undefined) return;
      plot.axes[place].range = null;
      plot.draw();
    });
    receive(plot.figure, (curves, event) => {
      const place = event.target.closest?.("[data-axis]")?.dataset.axis;
      const { dragged } = desk;
      if (dragged?.plot === plot && place !== undefined) return plot.move(dragged.curve, place);
      if (dragged && dragged.plot !== plot) dragged.plot.take(dragged.curve);
      if (dragged?.plot !== plot) desk.add(curves, plot, place === undefined ? null : Number(place));
    });
  }
  function stretch(each, plot, factor) {
    const range = plot.range(each);
    if (!range) return;
    const middle = (range[0] + range[1]) / 2;
    each.range = range.map((end) => middle + (end - middle) * factor);
    plot.draw();
  }
  function setPin(time) {
    desk.pin = desk.pin === null ? time : null;
    for (const curve of desk.plots.flatMap((p) => p.curves))
      curve.pinned = desk.pin !== null && curve.value ? curve.value.value : undefined;
    schedule();
  }
  function onKey(event, plot) {
    if (event.altKey || event.ctrlKey || event.metaKey) return;
    const { from, to } = desk.view,
      width = to - from,
      at = desk.cursor ?? (from + to) / 2,
      pixel = ((event.shiftKey ? 20 : 1) * width) / Math.max(1, plot.box.clientWidth);
    const deeds = {
      ArrowLeft: () => desk.seek(Math.max(from, at - pixel)),
      ArrowRight: () => desk.seek(Math.min(to, at + pixel)),
      Home: () => desk.seek(from),
      End: () => desk.seek(to),
      PageUp: () => desk.look(from - width / 2, to - width / 2),
      PageDown: () => desk.look(from + width / 2, to + width / 2),
      "+": () => desk.zoom(0.5, at),
      "=": () => desk.zoom(0.5, at),
      "-": () => desk.zoom(2, at),
      "*": () => plot.axes.forEach((each) => stretch(each, plot, 0.8)),
      "/": () => plot.axes.forEach((each) => stretch(each, plot, 1.25)),
      m: () => setPin(at),
      0: desk.home,
      Escape: desk.home,
      Delete: () => desk.remove(plot),
    };
    if (!(event.key in deeds)) return;
    event.preventDefault();
    deeds[event.key]();
    if (!event.key.startsWith("Arrow") && event.key !== "Home" && event.key !== "End") return;
    const values = plot.curves.map((c) => `${c.name} ${c.cell.textContent}`);
    tell(`${readable(desk.cursor)} s: ${values.join(", ")}`);
  }
  function receive(element, take) {
    element.addEventListener("dragover", (event) => {
      event.preventDefault();
      element.classList.add("over");
    });
    element.addEventListener("dragleave", () => element.classList.remove("over"));
    element.addEventListener("drop", (event) => {
      event.preventDefault();
      element.classList.remove("over");
      try {
        const { curves } = JSON.parse(event.dataTransfer.getData("text/plain"));
        if (curves.length) take(curves, event);
      } catch {
        tell("This is no signal.");
      }
    });
  }
  addEventListener("dragend", () => (desk.dragged = null));

  // -- tree ------------------------------------------------------------------------------------------------
  const tree = new SignalTree(one("#tree"), runs, (curves, isNew) => {
    desk.add(curves, isNew ? desk.addPlot("time") : desk.active);
  });
  const count = () => {
    const total = runs.reduce((sum, run) => sum + run.names.length + run.derived.length, 0);
    put(one("#count"), `${total} signals${runs.length > 1 ? ` of ${runs.length} runs` : ""}`);
  };
  count();
  one("#find").addEventListener("input", (event) => {
    tree.words = event.target.value.trim();
    tree.fill();
  });
  one("#find").addEventListener("keydown", (event) => {
    if (event.key === "ArrowDown") one("#tree").focus();
  });
  one("#group").addEventListener("change", (event) => {
    tree.group = event.target.value;
    tree.fill();
  });
  receive(one("#new-plot"), (curves) => {
    if (desk.dragged) desk.dragged.plot.take(desk.dragged.curve);
    desk.add(curves, desk.addPlot("time"));
  });

  // -- tools -----------------------------------------------------------------------------------------------
  one("#whole").addEventListener("click", desk.home);
  one("#add").addEventListener("click", () => desk.addPlot("time").title.focus());
  one("#add-plane").addEventListener("click", () => desk.addPlot("xy").title.focus());
  for (const field of [one("#from"), one("#to")])
    field.addEventListener("change", () => {
      const [from, to] = [one("#from"), one("#to")].map((f) => Number(f.value.replace("\u2212", "-")));
      if (from < to) desk.look(from, to);
      else desk.look(desk.view.from, desk.view.to);
    });

  // -- derived signals ---------------------------------------------------------------------------------------
  const LETTERS = ["a", "b", "c"];
  const fail = (place, error) => {
    place.hidden = !error;
    put(place, error?.message ?? "");
  };
  async function derive(name, formula, of, unit) {
    for (const made of await post("derive", { name, formula, of, unit })) takeDerived(made); // also what depends on it
  }
  function takeDerived(made) {
    const run = runs[made.run],
      isHere = (curve) => curve.run === made.run && curve.name === made.name;
    run.units[made.name] = made.unit;
    run.formulas = [...run.formulas.filter((f) => f.name !== made.name), made];
    run.derived = run.formulas.map(({ name }) => name);
    for (const plot of desk.plots.filter((each) => each.curves.some(isHere))) {
      for (const curve of plot.curves.filter(isHere)) Object.assign(curve, { unit: made.unit, value: null });
      plot.build();
    }
    for (const note of made.notes) warn(note);
  }
  function chosen() {
    const of = {};
    for (const letter of LETTERS) {
      const run = Number(one(`#run-${letter}`).value),
        { value } = one(`#letter-${letter}`),
        text = value in runs[run].units ? value : value.trim(); // a name may end in a blank
      if (!text || !one("#formula").value.match(`\\b${letter}\\b`)) continue;
      if (!(text in runs[run].units)) throw new Error(`${text} is no signal of ${runs[run].label}.`);
      if (runs[run].kinds[text] === "text") throw new Error(`${text} has texts, and a formula takes numbers.`);
      of[letter] = [run, text];
    }
    return of;
  }
  one("#derive").addEventListener("click", () => {
    const curves = desk.active.curves.map((c) => [c.run, c.name]);
    const options = () => runs.map((run, k) => make("option", { value: k }, run.label));
    one("#letters").replaceChildren(
      ...LETTERS.map((letter, k) => {
        const run = make("select", { id: `run-${letter}`, "aria-label": `Run of ${letter}` }, ...options());
        run.value = curves[k]?.[0] ?? 0;
        run.hidden = runs.length < 2;
        const about = { id: `letter-${letter}`, type: "text", list: "names", autocomplete: "off", spellcheck: "false" };
        const field = make("input", about);
        field.value = curves[k]?.[1] ?? "";
        return make("label", {}, `${letter} `, field, run);
      }),
      make(
        "datalist",
        { id: "names" },
        ...Object.keys(runs[0].units)
          .slice(0, 2000)
          .map((value) => make("option", { value })),
      ),
    );
    one("#ready").replaceChildren(...READY.map((text) => make("option", {}, text)));
    one("#formula").value = curves.length > 1 ? READY[0] : "der(a)";
    one("#derived-unit").value = "";
    one("#ready").value = one("#formula").value;
    name();
    listDerived();
    fail(one("#derive-error"), null);
    one("#derive-box").showModal();
  });
  // Derived signals by their names; a click shows the formula for a change.
  function listDerived() {
    const entry = (made) => {
      const label = `${made.name}${runs.length > 1 ? ` · ${runs[made.run].short}` : ""}`,
        show = make("button", { type: "button", title: desk.about(made) }, label),
        away = make("button", { type: "button", class: "away", "aria-label": `Remove ${label}` }, "×");
      show.addEventListener("click", () => showFormula(made));
      away.addEventListener("click", () => removeDerived(made).catch((error) => fail(one("#derive-error"), error)));
      return make("li", {}, show, " ", away);
    };
    one("#derived-list").replaceChildren(...runs.flatMap((run) => run.formulas).map(entry));
  }
  function showFormula({ name: label, formula, of, stated_unit: unit }) {
    for (const [letter, [run, signal]] of Object.entries(of).filter(([each]) => LETTERS.includes(each))) {
      one(`#run-${letter}`).value = run;
      one(`#letter-${letter}`).value = signal;
    }
    one("#formula").value = formula;
    one("#derived-name").value = label;
    one("#derived-unit").value = unit;
    one("#formula").focus();
  }
  async function removeDerived(made) {
    await post("derive", { remove: [made.run, made.name] });
    const run = runs[made.run];
    run.formulas = run.formulas.filter((f) => f.name !== made.name);
    run.derived = run.formulas.map(({ name: label }) => label);
    delete run.units[made.name];
    const isIt = (c) => c?.run === made.run && c.name === made.name;
    for (const plot of desk.plots) {
      if (isIt(plot.across)) plot.across = null;
      for (const curve of plot.curves.filter((c) => isIt(c) || (plot.kind === "xy" && !plot.across))) plot.take(curve);
    }
    fail(one("#derive-error"), null);
    renew();
    listDerived();
  }
  function renew() {
    tree.tries.clear();
    tree.union = null;
    tree.fill();
    count();
  }
  const name = () => {
    const used = LETTERS.filter((letter) => one("#formula").value.match(`\\b${letter}\\b`)),
      places = new Set(used.map((letter) => one(`#run-${letter}`).value));
    const words = (letter) => {
      const run = places.size > 1 ? ` (${runs[one(`#run-${letter}`).value].short})` : "";
      return (one(`#letter-${letter}`).value || letter) + run;
    };
    one("#derived-name").value = one("#formula").value.replace(/\b[abc]\b/g, words);
  };
  one("#ready").addEventListener("change", () => {
    one("#formula").value = one("#ready").value;
    name();
  });
  one("#letters").addEventListener("change", name);
  one("#formula").addEventListener("input", name);
  one("#derive-close").addEventListener("click", () => one("#derive-box").close());
  one("#derive-form").addEventListener("submit", async (event) => {
    event.preventDefault();
    try {
      const of = chosen(),
        [label, formula, unit] = ["#derived-name", "#formula", "#derived-unit"].map((id) => one(id).value.trim());
      if (!Object.keys(of).length) throw new Error("Give at least the signal of one letter.");
      const first = Object.values(of)[0][0],
        sameRun = Object.values(of).every(([run]) => run === first);
      const added = [];
      for (const place of [first, ...[...runs.keys()].filter((k) => k !== first)]) {
        const has = Object.values(of).every(([, signal]) => signal in runs[place].units);
        if (place !== first && !(one("#every-run").checked && sameRun && has)) continue;
        const here = place === first ? of : Object.fromEntries(Object.entries(of).map(([k, [, s]]) => [k, [place, s]]));
        try {
          await derive(label, formula, here, unit);
          added.push([place, label]);
        } catch (error) {
          if (place === first) throw error;
          warn(`${label} of ${runs[place].label} is left out: ${error.message}`);
        }
      }
      renew();
      one("#derive-box").close();
      desk.add(added, desk.active);
    } catch (error) {
      fail(one("#derive-error"), error);
    }
  });

  // -- layouts -----------------------------------------------------------------------------------------------
  const named = ({ run, name: signal, ...more }) => ({ run: runs[run].name, name: signal, ...more });
  function layout() {
    const derived = runs.flatMap((run) =>
      run.formulas.map(({ name: signal, formula, of, stated_unit: unit }) => ({
        name: signal,
        formula,
        unit,
        of: Object.fromEntries(Object.entries(of).map(([k, [r, s]]) => [k, { run: runs[r].name, name: s }])),
      })),
    );
    const plots = desk.plots.map(({ kind, across, axes }) => ({
      kind,
      across: across && named(across),
      axes: axes.map(({ range, curves }) => ({
        range,
        curves: curves.map(({ run, name: signal, colour, hidden }) => named({ run, name: signal, colour, hidden })),
      })),
    }));
    return { view: { ...desk.view }, plots, derived };
  }
  // A run of a layout that is not here is the only one, if there is only one in both.
  async function open(content) {
    const names = new Set(content.plots.flatMap((p) => p.axes.flatMap((a) => a.curves.map((c) => c.run))));
    const find = (label) => (names.size === 1 && runs.length === 1 ? 0 : runs.findIndex((run) => run.name === label));
    const missing = [],
      wrong = [];
    await deriveAll(content.derived ?? [], find, missing, wrong);
    const known = (c) => {
      const run = find(c.run);
      if (run >= 0 && c.name in runs[run].units) return [{ ...c, run }];
      missing.push(`${c.name} of ${c.run}`);
      return [];
    };
    for (const plot of desk.plots) plot.figure.remove();
    desk.plots = [];
    for (const { kind, across, axes } of content.plots) {
      const plot = desk.addPlot(kind === "xy" ? "xy" : "time");
      plot.across = across ? (known(across)[0] ?? null) : null;
      plot.axes = axes.map(({ range, curves }) => ({
        range: Array.isArray(range) ? range.map(Number) : null,
        curves: (plot.kind === "xy" && !plot.across ? [] : curves.flatMap(known)).map((c) => ({
          run: c.run,
          name: c.name,
          colour: Number(c.colour) || 0,
          hidden: Boolean(c.hidden),
          unit: runs[c.run].units[c.name] || "",
          kind: runs[c.run].kinds[c.name],
          data: null,
          value: null,
        })),
      }));
      if (!plot.axes.length) plot.axes = [{ curves: [], range: null }];
      plot.build();
    }
    if (!desk.plots.length) desk.addPlot("time");
    renew();
    const { from, to } = content.view ?? desk.extent;
    desk.look(Number(from), Number(to));
    if (missing.length)
      warn(`Not in these runs, and left out: ${missing.slice(0, 5).join(", ")}${missing.length > 5 ? ", …" : ""}`);
    for (const words of wrong) warn(words);
  }
  // Derived signals of a layout, each after those that it depends on, in whatever order the file has them.
  async function deriveAll(formulas, find, missing, wrong) {
    let waiting = formulas.map(({ name: signal, formula, unit, of }) => {
      const here = Object.fromEntries(Object.entries(of).map(([k, c]) => [k, [find(c.run), c.name]]));
      return { signal, formula, unit, here, run: Object.values(here)[0][0] };
    });
    const waits = (each) =>
      Object.values(each.here).some(([run, signal]) =>
        waiting.some((other) => other.run === run && other.signal === signal),
      );
    for (let next; (next = waiting.find((each) => !waits(each))); ) {
      waiting = waiting.filter((each) => each !== next);
      if (Object.values(next.here).some(([run, name]) => run < 0 || !(name in runs[run].units)))
        missing.push(next.signal);
      else
        await derive(next.signal, next.formula, next.here, next.unit).catch((error) =>
          wrong.push(`${next.signal} is left out: ${error.message}`),
        );
    }
    if (waiting.length) wrong.push(`Derived from themselves, and left out: ${waiting.map((f) => f.signal).join(", ")}`);
  }
  const attempt = async (deed) => {
    try {
      fail(one("#layout-error"), null);
      await deed();
    } catch (error) {
      fail(one("#layout-error"), error);
    }
  };
  function listLayouts() {
    one("#layout-list").replaceChildren(
      ...Object.keys(layouts).map((label) => {
        const show = make("button", { type: "button", class: "act" }, label),
          away = make("button", { type: "button", class: "away", "aria-label": `Remove the layout ${label}` }, "×");
        show.addEventListener("click", () => {
          one("#layout-name").value = label;
          attempt(() => open(layouts[label]));
        });
        away.addEventListener("click", () => attempt(() => putLayout(label, null)));
        return make("li", {}, show, away);
      }),
    );
  }
  async function putLayout(label, content) {
    layouts = await post("layouts", { name: label, layout: content });
    listLayouts();
    tell(content ? `Layout ${label} is saved.` : `Layout ${label} is removed.`);
  }
  one("#layout-form").addEventListener("submit", (event) => {
    event.preventDefault();
    attempt(() => putLayout(one("#layout-name").value.trim(), layout()));
  });
  one("#download").addEventListener("click", () => {
    const label = one("#layout-name").value.trim() || "layout";
    const content = { schema_version: 1, layouts: { [label]: layout() } };
    save(new Blob([JSON.stringify(content, null, 2)], { type: "application/json" }), `${safeName(label)}.json`);
  });
  one("#upload").addEventListener("change", (event) =>
    attempt(async () => {
      const [file] = event.target.files,
        text = await file.text();
      event.target.value = "";
      let content = null; // which is refused like all that is no file of layouts
      try {
        content = JSON.parse(text);
      } catch {}
      const [first] = Object.values(await post("layouts", { file: file.name, content }));
      if (!first) throw new Error("This file holds no layout.");
      await open(first);
    }),
  );
  listLayouts();

  // -- start ---------------------------------------------------------------------------------------------------
  const events = new EventSource("events");
  events.onmessage = (event) => {
    for (const words of JSON.parse(event.data).lost ?? []) warn(words);
  };
  events.onerror = () => warn("The command has ended. What it has sent stays on this page.");
  const first = layouts.last ?? layouts[Object.keys(layouts)[0]];
  desk.addPlot("time");
  desk.look(whole.from, whole.to);
  if (first) await attempt(() => open(first));
  new ResizeObserver(() => {
    for (const plot of desk.plots) plot.fresh = false;
    schedule();
  }).observe(one("#charts"));
  addEventListener("beforeprint", () => {
    desk.listRuns();
    draw(desk.plots);
  });
  document.documentElement.dataset.ready = "view";
})();
