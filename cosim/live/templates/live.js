// A running command: its state arrives as events, rows are fetched for what is shown, changes are sent.
/* global axis, MINUS, one, all, make, put, readable, post, extremesPath, tickLabels, gridPaths */
(() => {
  "use strict";
  const activity = one("#live").dataset.activity;
  const FINAL = ["finished", "stopped", "failed"];
  let state = null;

  const duration = (s) => {
    if (s === null || s === undefined) return "";
    if (s < 100) return `${s < 10 ? s.toFixed(1) : s.toFixed(0)} s`;
    return s < 6000 ? `${(s / 60).toFixed(0)} min` : `${(s / 3600).toFixed(1)} h`;
  };

  // -- bar of every page ---------------------------------------------------------------------------
  const stop = one("#stop"),
    phase = one("#phase"),
    message = one("#message");
  stop.addEventListener("click", () => {
    stop.disabled = true;
    post("stop", true).catch((error) => tell(error.message));
  });
  function tell(words) {
    message.hidden = !words;
    put(message, words);
    message.className = `outcome ${state?.phase === "failed" ? "bad" : ""}`;
  }
  function showBar() {
    put(phase, state.phase);
    phase.className = `phase ${state.phase}`;
    const ended = FINAL.includes(state.phase);
    stop.hidden = ended || state.phase === "writing";
    if (ended) stop.disabled = true;
    one("#report").hidden = !state.report;
    if (one("h1").textContent !== state.title) {
      put(one("h1"), state.title);
      document.title = `${state.title} · live ${activity}`;
    }
    tell(
      state.message ||
        (state.phase === "stopped" ? "Stopped. What was made so far is kept." : "") ||
        (state.phase === "finished" ? `The ${activity} is complete.` : ""),
    );
    if (ended) message.classList.toggle("good", state.phase === "finished");
  }

  // -- run -------------------------------------------------------------------------------------------
  const W = 4000,
    H = 1000,
    AT_FIRST = 24, // signals drawn at first
    IN_CHART = 6; // curves in one chart: one for each colour
  const run = {
    made: null,
    signals: [],
    inputs: new Set(),
    charts: [],
    shown: new Set(),
    busy: false,
    data: null,
    cursor: null,
    window: "so far",

    async show() {
      const { rows, now, end, speed, total } = state;
      put(one("#now"), now.toFixed(Math.min(6, Math.max(0, -Math.floor(Math.log10(state.step ?? 0.01) + 1e-9)))));
      put(one("#of"), `of ${readable(end)} s`);
      one("#share").value = total > 1 ? Math.max(0, rows - 1) / (total - 1) : 0;
      const pause = one("#pause"),
        going = ["running", "paused"].includes(state.phase);
      put(one("#rate"), going && speed ? `${readable(+speed.toPrecision(3))} × real time` : `${rows} rows`);
      pause.hidden = !going;
      put(pause, state.phase === "paused" ? "Continue" : "Pause");
      pause.setAttribute("aria-pressed", String(state.phase === "paused"));
      if (state.made !== this.made && state.made) {
        this.made = state.made;
        await this.begin();
      }
      this.showChanges();
      for (const field of all(".change [data-now]")) {
        const value = state.values?.[field.dataset.now];
        if (value !== undefined) put(field, `now ${readable(value)}`);
      }
      const ended = FINAL.includes(state.phase) || state.phase === "writing";
      for (const part of all(".change input, .change select, .change button")) part.disabled = ended;
      await this.draw();
    },

    async begin() {
      const about = await (await fetch("about")).json();
      this.signals = about.signals;
      this.inputs = new Set(about.variables.filter(({ input }) => input).map(({ name }) => name));
      this.offerWindows();
      this.listSignals();
      this.listVariables(about.variables);
      this.layOut();
    },

    offerWindows() {
      const span = state.end - state.start,
        select = one("#window");
      const parts = [0.5, 0.2, 0.1, 0.05, 0.02, 0.01].map((share) => +(share * span).toPrecision(1));
      select.replaceChildren(
        make("option", { value: "so far" }, "all so far"),
        make("option", { value: "all" }, "whole duration"),
        ...[...new Set(parts)].map((s) => make("option", { value: s }, `last ${readable(s)} s`)),
      );
      select.value = this.window = "so far";
    },

    listSignals() {
      const parts = new Map();
      this.signals.forEach((signal, place) => {
        const name = signal.name.split(".")[0];
        if (!parts.has(name)) parts.set(name, make("fieldset", {}, make("legend", {}, name)));
        const box = make("input", { type: "checkbox", value: place });
        box.checked = place < AT_FIRST;
        if (box.checked) this.shown.add(place);
        box.addEventListener("change", () => {
          if (box.checked) this.shown.add(place);
          else this.shown.delete(place);
          this.layOut();
          this.draw();
        });
        const unit = make("span", { class: "unit" }, signal.unit ? `[${signal.unit}]` : "");
        const words = signal.name.slice(name.length + 1),
          label = make("label", { "data-name": signal.name.toLowerCase() }, box, words);
        label.append(" ", unit);
        parts.get(name).append(label);
      });
      one("#signals").replaceChildren(...parts.values());
    },

    // One chart for each unit of a component; signals without a unit have charts of their own, because nothing says
    // that they can share an axis.
    layOut() {
      const groups = new Map();
      for (const place of [...this.shown].sort((a, b) => a - b)) {
        const { name, unit } = this.signals[place],
          component = name.split(".")[0],
          key = unit ? `${component} ${unit}` : name;
        const group = groups.get(key) ?? { title: unit ? component : name, unit: unit || "no unit", places: [], key };
        const full = group.places.length === IN_CHART;
        if (full) {
          groups.delete(key);
          groups.set(`${key} ${groups.size}`, group);
        }
        groups.set(key, full ? { ...group, places: [place] } : { ...group, places: [...group.places, place] });
      }
      const isInput = ({ places }) => places.every((place) => this.inputs.has(this.signals[place].name));
      const order = [...groups.values()].sort((a, b) => isInput(a) - isInput(b)); // what is set comes last
      this.charts = order.map((group) => new Chart(group, this));
      one("#plots").replaceChildren(...this.charts.map((chart) => chart.figure));
      one("#plots").style.gridTemplateColumns = this.charts.length < 2 ? "minmax(0, 1fr)" : "";
      put(one("#signal-count"), `${this.shown.size} of ${this.signals.length} shown`);
    },

    async draw() {
      if (this.busy || !this.charts.length || !state.rows) return;
      this.busy = true;
      try {
        const from = this.window === "so far" || this.window === "all" ? state.start : state.now - Number(this.window),
          to = this.window === "all" ? state.end : state.now,
          places = this.charts.flatMap((chart) => chart.places);
        const width = Math.max(200, Math.round(this.charts[0].box.clientWidth || 500));
        const query = new URLSearchParams({ signals: places.join(","), from, to, count: width });
        const raw = await (await fetch(`rows?${query}`)).arrayBuffer();
        const numbers = new Float64Array(raw),
          [first, every, count, signals] = numbers;
        const part = (begin, length, k) => numbers.subarray(5 + begin + k * length, 5 + begin + (k + 1) * length);
        const curves = new Map();
        places.forEach((place, k) => {
          const low = part(0, count, k),
            high = part(signals * count, count, k);
          curves.set(place, { low, high, last: numbers[5 + 2 * signals * count + k] });
        });
        one("#no-rows").hidden = count > 0;
        const view = { from: Math.max(from, state.start), to: to > from ? to : from + state.step };
        this.data = { first, every, count, curves, view };
        for (const chart of this.charts) chart.draw(this.data);
        this.read();
        put(one("#shown"), every > state.step * 1.5 ? `least and largest of each ${readable(every)} s` : "every row");
      } finally {
        this.busy = false;
      }
    },

    // Values at the cursor, else the latest.
    read() {
      if (!this.data) return;
      const { first, every, count, curves, view } = this.data;
      one(".charts").classList.toggle("reading", this.cursor !== null);
      let row = null;
      if (this.cursor !== null) {
        const t = view.from + this.cursor * (view.to - view.from);
        row = Math.max(0, Math.min(count - 1, Math.round((t - first) / every)));
        const at = first + row * every;
        const share = (at - view.from) / (view.to - view.from);
        one(".charts").style.setProperty("--cursor", `${(100 * share).toFixed(3)}%`);
        one(".charts").classList.toggle("cursor-late", this.cursor > 0.8);
        for (const tag of all(".charts .when")) put(tag, `${readable(at)} s`);
      }
      for (const chart of this.charts)
        for (const [place, cell] of chart.cells) {
          const { low, high, last } = curves.get(place) ?? {};
          if (row === null) put(cell, readable(last));
          else
            put(cell, low[row] === high[row] ? readable(low[row]) : `${readable(low[row])} … ${readable(high[row])}`);
        }
    },

    showChanges() {
      const changes = state.changes ?? [];
      const log = one("#log");
      if (log.children.length === changes.length) return;
      log.replaceChildren(
        ...[...changes].reverse().map(({ at, set }) => {
          const values = Object.entries(set).map(([name, value]) => `${name} = ${readable(value)}`);
          return make("li", {}, make("span", {}, `t = ${readable(at)} s  `), values.join(", "));
        }),
      );
      put(one("#told"), log.firstChild?.textContent ?? "");
      for (const field of all(".change [data-set]")) {
        const value = changes.map(({ set }) => set[field.dataset.set]).findLast((v) => v !== undefined);
        if (value !== undefined) put(field, `now ${readable(value)}`);
      }
    },

    listVariables(variables) {
      one("#no-variables").hidden = variables.length > 0;
      put(one("#change-count"), variables.length ? `${variables.length} variables` : "");
      one("#variable-filter").hidden = variables.length < 7;
      one("#variables").replaceChildren(...variables.map((variable, k) => changeForm(variable, k)));
    },
  };

  class Chart {
    constructor({ title: group, unit, places }, owner) {
      const title = places.length > 1 ? group : owner.signals[places[0]].name;
      this.places = places;
      this.lines = places.map((_, k) => make("path", { class: `line s${k}` }));
      this.cells = places.map((place) => [place, make("output", {})]);
      this.grid = make("g", { class: "grid" });
      this.events = make("path", { class: "event" });
      this.zero = make("path", { class: "zero" });
      const shown = { viewBox: `0 0 ${W} ${H}`, preserveAspectRatio: "none", "aria-hidden": "true" };
      const svg = make("svg", shown, this.grid, this.zero, this.events, ...this.lines);
      this.box = make(
        "div",
        { class: "box", tabindex: 0, role: "img", "aria-label": `${title}, drawn over time; arrow keys read values` },
        svg,
        make("span", { class: "cursor", "aria-hidden": "true" }, make("span", { class: "when" })),
      );
      this.yTicks = make("div", { class: "y-ticks", "aria-hidden": "true" });
      this.xTicks = make("div", { class: "x-ticks", "aria-hidden": "true" });
      this.factor = make("span", { class: "factor", "aria-hidden": "true" });
      const entries = places.map((place, k) =>
        make(
          "span",
          { class: "entry" },
          make("svg", { class: "swatch", viewBox: "0 0 22 8" }, make("path", { class: `line s${k}`, d: "M0 4h22" })),
          make("span", {}, owner.signals[place].name),
          this.cells[k][1],
        ),
      );
      const heading = make("span", { class: "plot-title" }, `${title} `, make("span", { class: "unit" }, `[${unit}]`));
      this.figure = make(
        "figure",
        { class: "plot", role: "group", "aria-label": `${title} in ${unit}` },
        make("figcaption", {}, heading, make("span", { class: "legend" }, ...entries)),
        make(
          "div",
          { class: "axes" },
          this.yTicks,
          this.box,
          this.factor,
          this.xTicks,
          make("div", { class: "x-label", "aria-hidden": "true" }, "time [s]"),
        ),
      );
      const move = (share) => {
        owner.cursor = share === null ? null : Math.max(0, Math.min(1, share));
        owner.read();
      };
      this.box.addEventListener("pointermove", (event) => move(event.offsetX / this.box.clientWidth));
      this.box.addEventListener("pointerleave", () => move(null));
      this.box.addEventListener("blur", () => move(null));
      this.box.addEventListener("keydown", (event) => {
        const steps = { ArrowLeft: -0.01, ArrowRight: 0.01, PageUp: -0.1, PageDown: 0.1 };
        if (event.key in steps) move((owner.cursor ?? 1) + steps[event.key]);
        else if (event.key === "Home") move(0);
        else if (event.key === "End") move(1);
        else if (event.key === "Escape") move(null);
        else return;
        event.preventDefault();
      });
    }

    draw({ first, every, count, curves, view }) {
      let low = Infinity,
        high = -Infinity;
      for (const place of this.places) {
        const curve = curves.get(place);
        for (let k = 0; k < count; k++) {
          if (curve.low[k] < low) low = curve.low[k];
          if (curve.high[k] > high) high = curve.high[k];
        }
      }
      if (low > high) return;
      const margin = 0.06 * (high - low) || 0.1 * Math.abs(high) || 1,
        y = axis(low - margin, high + margin, 5),
        x = axis(view.from, view.to, this.box.clientWidth < 420 ? 4 : 6);
      const u = (t) => Math.round((W * (t - view.from)) / (view.to - view.from)),
        v = (value) => Math.round(H * (1 - (value - y.low) / (y.high - y.low)));
      this.yTicks.replaceChildren(...tickLabels(y.ticks, "bottom"));
      this.xTicks.replaceChildren(...tickLabels(x.ticks, "left"));
      put(this.factor, y.factor);
      this.grid.replaceChildren(...gridPaths(x, y, W, H));
      this.zero.setAttribute("d", y.low < 0 && y.high > 0 ? `M0 ${v(0)}h${W}` : "");
      const times = (state.changes ?? []).map(({ at }) => at).filter((t) => t >= view.from && t <= view.to);
      this.events.setAttribute("d", times.map((t) => `M${u(t)} 0v${H}`).join(""));
      this.places.forEach((place, k) => {
        const { low, high } = curves.get(place);
        const path = extremesPath(
          count,
          (n) => u(first + n * every),
          (n) => v(low[n]),
          (n) => v(high[n]),
        );
        this.lines[k].setAttribute("d", path);
      });
    }
  }

  // A variable with its field, its limits and the value that acts.
  function changeForm(variable, number) {
    const { name, unit, kind, items, bounds, start, description } = variable,
      id = `variable-${number}`,
      [least, most] = bounds,
      isNumber = !["Boolean", "String", "Enumeration"].includes(kind);
    let field;
    if (kind === "Boolean" || (kind === "Enumeration" && items.length)) {
      const choices = kind === "Boolean" ? ["false", "true"] : items;
      field = make("select", { id }, ...choices.map((choice) => make("option", { value: choice }, choice)));
      field.value = String(start);
    } else {
      const about = { id, type: "text", autocomplete: "off", spellcheck: "false" };
      field = make("input", { ...about, inputmode: isNumber ? "text" : null });
      field.value = start === null ? "" : readable(isNumber && !isNaN(Number(start)) ? Number(start) : start);
    }
    field.setAttribute("aria-describedby", `${id}-about`);
    const acting = { class: "unit", [variable.input && isNumber ? "data-now" : "data-set"]: name };
    const range =
      !items.length && (least !== null || most !== null) ? `${readable(least)} … ${readable(most)} ${unit}` : "";
    const note = make("p", { class: "note", id: `${id}-about` }, [range, description].filter(Boolean).join(" · "));
    const error = make("p", { class: "error", role: "alert", hidden: "" });
    const label = make("label", { for: id }, `${name} `, make("span", { class: "unit" }, unit ? `[${unit}]` : ""));
    const now = start === null ? "" : `now ${readable(isNumber && !isNaN(Number(start)) ? Number(start) : start)}`;
    const head = make("div", { class: "head" }, label, make("span", acting, now));
    const row = make("div", { class: "row" }, field, make("button", { class: "act" }, "Set"));
    const form = make("form", { class: "change", "data-name": name.toLowerCase() }, head, row);
    const send = async (value) => {
      try {
        await post("set", { [name]: kind === "Boolean" ? value === "true" : value });
        error.hidden = true;
        field.removeAttribute("aria-invalid");
      } catch (refusal) {
        put(error, refusal.message.replace(`${name}: `, ""));
        error.hidden = false;
        field.setAttribute("aria-invalid", "true");
      }
    };
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      send(field.value);
    });
    if (isNumber && least !== null && most !== null && most - least < 1e9) {
      const step = kind === "Real" || kind.startsWith("Float") ? "any" : "1";
      const slider = make("input", { type: "range", min: least, max: most, step, "aria-label": `${name}, slider` });
      slider.value = Number(start ?? least);
      slider.addEventListener("input", () => (field.value = readable(Number(slider.value))));
      slider.addEventListener("change", () => send(Number(slider.value)));
      field.addEventListener("change", () => (slider.value = Number(field.value.replace(MINUS, "-"))));
      form.append(slider);
    }
    form.append(note, error);
    return form;
  }

  function filtered(field, selector) {
    field.addEventListener("input", () => {
      const words = field.value.toLowerCase().split(/\s+/).filter(Boolean);
      for (const part of all(selector)) part.hidden = !words.every((word) => part.dataset.name.includes(word));
    });
  }
  if (activity === "run") {
    filtered(one("#signal-filter"), "#signals label");
    filtered(one("#variable-filter"), "#variables form");
    one("#window").addEventListener("change", (event) => {
      run.window = event.target.value;
      run.draw();
    });
    one("#pause").addEventListener("click", () => {
      post("pause", state.phase !== "paused").catch((error) => tell(error.message));
    });
    addEventListener("resize", () => run.draw());
  }

  // -- sweep ------------------------------------------------------------------------------------------
  const sweep = {
    show() {
      const { done, total, failed, rate, remaining, elapsed, criteria } = state;
      put(one("#now"), String(done ?? 0));
      put(one("#of"), `of ${total ?? 0} runs`);
      one("#share").value = total ? done / total : 0;
      put(one("#rate"), remaining ? `about ${duration(remaining)} left` : "");
      const tiles = [
        ["finished runs", `${done} of ${total}`],
        ["failed", String(failed)],
        ["runs a second", rate ? readable(+rate.toPrecision(3)) : "–"],
        ["time", duration(elapsed)],
      ];
      one("#tiles").replaceChildren(
        ...tiles.map(([label, value]) => make("div", {}, make("dt", {}, label), make("dd", {}, value))),
      );
      one("#criteria").replaceChildren(...criteria.map((c) => this.row(c)));
      const failures = one("#failures");
      failures.hidden = !state.failures.length;
      failures.replaceChildren(
        ...state.failures.map(({ why, count }) => make("li", {}, `${count} ${count > 1 ? "runs" : "run"}: ${why}`)),
      );
    },

    row({ name, max, unit, met, of, low, high, counts, ends }) {
      const percent = (share) => `${(100 * share).toFixed(1)}%`,
        width = 240 / counts.length,
        top = Math.max(1, ...counts),
        [from, to] = ends,
        at = (240 * (max - from)) / (to - from || 1);
      const bars = counts.map((count, k) => {
        const height = (40 * count) / top,
          place = { x: (k * width).toFixed(1), y: (42 - height).toFixed(1) };
        const beyond = (k + 0.5) * width > at ? "beyond" : null;
        return make("rect", { ...place, width: (width - 1).toFixed(1), height: height.toFixed(1), class: beyond });
      });
      const told = `values from ${readable(from)} to ${readable(to)} ${unit}, limit ${readable(max)} ${unit}`;
      const picture = make(
        "svg",
        { class: "histogram", viewBox: "0 0 240 44", role: "img", "aria-label": told },
        ...bars,
        make("path", { d: counts.length ? `M${at.toFixed(1)} 0v44` : "" }),
      );
      const bar = make(
        "span",
        { class: "share" },
        make("i", { style: `width:${percent(of ? met / of : 0)}` }),
        make("b", { style: `left:${percent(low)};width:${percent(high - low)}` }),
      );
      const share = make("td", { class: "sized" }, bar);
      const words = of ? `${percent(met / of)} (${percent(low)} … ${percent(high)})` : "";
      share.append(make("span", { class: "note" }, words));
      const scale = make("span", { class: "scale note", "aria-hidden": "true" });
      for (const end of counts.length ? [from, to] : []) scale.append(make("span", {}, readable(+end.toPrecision(3))));
      return make(
        "tr",
        {},
        make("th", { scope: "row" }, name),
        make("td", { class: "num" }, `${readable(max)} ${unit}`),
        make("td", { class: "num" }, `${met} of ${of}`),
        share,
        make("td", {}, picture, scale),
      );
    },
  };

  // -- refinement -------------------------------------------------------------------------------------
  const refinement = {
    show() {
      const { done, total, stages, words, ranking, elapsed, fitted } = state;
      put(one("#now"), String(Math.min(total, done + (FINAL.includes(state.phase) ? 0 : 1))));
      put(one("#of"), `of ${total} stages`);
      one("#share").value = total ? (done + (FINAL.includes(state.phase) ? 0 : state.share)) / total : 0;
      put(one("#rate"), duration(elapsed));
      const marks = { done: "✓", now: "▸", waiting: "" };
      one("#stages").replaceChildren(
        ...stages.map((stage) => {
          const item = make("li", { class: stage.state }, make("span", { "aria-hidden": "true" }, marks[stage.state]));
          item.append(stage.words, make("span", { class: "quiet" }, duration(stage.seconds)));
          if (stage.state === "now") {
            item.setAttribute("aria-current", "step");
            if (words !== stage.words) item.append(make("span", { class: "words" }, words));
          }
          return item;
        }),
      );
      const most = Math.max(1e-9, ...ranking.map(({ gain }) => gain ?? 0));
      one("#ranking").replaceChildren(
        ...ranking.map(({ names, gain }) => {
          const width = `width:${(100 * Math.max(0, gain ?? 0)) / most}%`;
          return make(
            "tr",
            {},
            make("th", { scope: "row", class: "wrap" }, names.join(" + ") || "base model, recalibrated"),
            make("td", { class: "num" }, gain === null ? "–" : readable(+gain.toPrecision(3))),
            make("td", {}, make("span", { class: "gain" }, make("i", { style: width }))),
          );
        }),
      );
      put(one("#fitted"), fitted ? `${fitted} hypotheses fitted` : "");
    },
  };

  // -- events -----------------------------------------------------------------------------------------
  const page = { run, sweep, refinement }[activity];
  const events = new EventSource("events");
  events.onmessage = async (event) => {
    state = JSON.parse(event.data);
    showBar();
    await page.show();
    document.documentElement.dataset.live = state.phase;
  };
  events.onerror = () => {
    if (state && FINAL.includes(state.phase)) {
      events.close(); // the command has ended
      one("#report").hidden = true;
      return;
    }
    put(phase, "lost");
    phase.className = "phase lost";
    tell("The command does not answer. What it has sent stays on this page.");
  };
})();
