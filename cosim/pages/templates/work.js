// A running command: its state arrives as events, changes are sent. A page of finished runs hears of their files.
/* global MINUS, one, all, make, put, readable, startView */

// The answer to JSON; an answer that is an error is thrown with its reason.
async function request(path, content) {
  const headers = { "Content-Type": "application/json" },
    answer = await fetch(path, { method: "POST", headers, body: JSON.stringify(content) });
  if (!answer.ok) throw new Error((await answer.json()).error);
  return answer;
}
const post = async (path, content) => (await request(path, content)).json();

(() => {
  "use strict";
  const FINAL = ["finished", "stopped", "failed"],
    activity = one("#live")?.dataset.activity ?? "view";
  let state = null;

  const duration = (s) => {
    if (s === null || s === undefined) return "";
    if (s < 100) return `${s < 10 ? s.toFixed(1) : s.toFixed(0)} s`;
    return s < 6000 ? `${(s / 60).toFixed(0)} min` : `${(s / 3600).toFixed(1)} h`;
  };

  // -- bar of every command ------------------------------------------------------------------------
  function tell(words) {
    one("#message").hidden = !words;
    put(one("#message"), words);
    const isGood = state?.phase === "finished";
    one("#message").className = `outcome ${isGood ? "good" : state?.phase === "failed" ? "bad" : ""}`;
  }
  function showBar() {
    const ended = FINAL.includes(state.phase);
    put(one("#phase"), state.phase);
    one("#phase").className = `phase ${state.phase}`;
    one("#stop").hidden = ended || state.phase === "writing";
    if (ended) one("#stop").disabled = true;
    one("#report").hidden = !state.report;
    put(one("h1"), state.title);
    document.title = `${state.title} · live ${activity}`;
    const kept = { stopped: "Stopped. The results so far are kept.", finished: `The ${activity} is complete.` };
    tell(state.message || kept[state.phase] || "");
  }
  one("#stop")?.addEventListener("click", () => {
    one("#stop").disabled = true;
    post("stop", true).catch((error) => tell(error.message));
  });

  // -- run -----------------------------------------------------------------------------------------
  const view = {
    desk: null,
    async show() {
      this.desk ??= await startView();
      this.desk.grow(state.spans, 0);
      for (const words of state.lost) this.desk.warn(words);
    },
  };
  const run = {
    desk: null,
    async show() {
      const { rows, now, end, speed, total, phase } = state,
        isGoing = ["running", "paused"].includes(phase);
      put(one("#now"), now.toFixed(Math.min(6, Math.max(0, -Math.floor(Math.log10(state.step ?? 0.01) + 1e-9)))));
      put(one("#of"), `of ${readable(end)} s`);
      one("#share").value = total > 1 ? Math.max(0, rows - 1) / (total - 1) : 0;
      put(one("#rate"), isGoing && speed ? `${readable(+speed.toPrecision(3))} × real time` : `${rows} rows`);
      one("#pause").hidden = !isGoing;
      put(one("#pause"), phase === "paused" ? "Continue" : "Pause");
      one("#pause").setAttribute("aria-pressed", String(phase === "paused"));
      one("#no-rows").hidden = rows > 0;
      if (!this.desk && state.made && rows) await this.begin();
      if (!this.desk) return;
      this.desk.changes = state.changes;
      this.desk.grow(state.spans, end);
      this.showChanges();
      for (const field of all(".change [data-now]"))
        if (state.values[field.dataset.now] !== undefined)
          put(field, `now ${readable(state.values[field.dataset.now])}`);
      const isOver = FINAL.includes(phase) || phase === "writing";
      for (const part of all(".change input, .change select, .change button")) part.disabled = isOver;
    },
    async begin() {
      const variables = await (await fetch("variables")).json(),
        span = state.end - state.start,
        parts = [0.5, 0.2, 0.1, 0.05, 0.02, 0.01].map((share) => +(share * span).toPrecision(1)),
        choices = [
          ["so far", "all so far"],
          ["all", "whole duration"],
          ["", "as zoomed"],
        ];
      choices.splice(2, 0, ...[...new Set(parts)].map((s) => [s, `last ${readable(s)} s`]));
      one("#window").replaceChildren(...choices.map(([value, words]) => make("option", { value }, words)));
      one("#no-variables").hidden = variables.length > 0;
      put(one("#change-count"), variables.length ? `${variables.length} variables` : "");
      one("#variable-filter").hidden = variables.length < 7;
      one("#variables").replaceChildren(...variables.map((variable, k) => changeForm(variable, k)));
      this.desk = await startView(new Set(variables.filter(({ input }) => input).map(({ name }) => name)));
      one("#window").addEventListener("change", (event) => this.desk.follow(event.target.value, state.end));
    },
    showChanges() {
      const { changes } = state,
        log = one("#log");
      if (log.children.length === changes.length) return;
      const entries = [...changes].reverse().map(({ at, set }) => {
        const values = Object.entries(set).map(([name, value]) => `${name} = ${readable(value)}`);
        return make("li", {}, make("span", {}, `t = ${readable(at)} s  `), values.join(", "));
      });
      log.replaceChildren(...entries);
      put(one("#told"), log.firstChild?.textContent ?? "");
      for (const field of all(".change [data-set]")) {
        const value = changes.map(({ set }) => set[field.dataset.set]).findLast((v) => v !== undefined);
        if (value !== undefined) put(field, `now ${readable(value)}`);
      }
    },
  };
  one("#pause")?.addEventListener("click", () => {
    post("pause", state.phase !== "paused").catch((error) => tell(error.message));
  });
  one("#variable-filter")?.addEventListener("input", (event) => {
    const words = event.target.value.toLowerCase().split(/\s+/).filter(Boolean);
    for (const part of all("#variables form")) part.hidden = !words.every((word) => part.dataset.name.includes(word));
  });

  // A variable with its field, its limits and the value that acts.
  const isNumber = ({ kind }) => !["Boolean", "String", "Enumeration"].includes(kind),
    shown = (variable, value) => readable(isNumber(variable) && !isNaN(Number(value)) ? Number(value) : value);
  function fieldOf(variable, id) {
    const { kind, items, start } = variable,
      about = { id, "aria-describedby": `${id}-about` };
    if (kind === "Boolean" || (kind === "Enumeration" && items.length)) {
      const choices = kind === "Boolean" ? ["false", "true"] : items;
      const field = make("select", about, ...choices.map((choice) => make("option", { value: choice }, choice)));
      field.value = String(start);
      return field;
    }
    const field = make("input", { ...about, type: "text", autocomplete: "off", spellcheck: "false" });
    field.value = start === null ? "" : shown(variable, start);
    return field;
  }
  function changeForm(variable, number) {
    const { name, unit, kind, items, bounds, start, description } = variable,
      id = `variable-${number}`,
      [least, most] = bounds,
      hasRange = !items.length && (least !== null || most !== null),
      field = fieldOf(variable, id),
      acting = { class: "unit", [variable.input && isNumber(variable) ? "data-now" : "data-set"]: name },
      range = hasRange ? `${readable(least)} … ${readable(most)} ${unit}` : "",
      note = make("p", { class: "note", id: `${id}-about` }, [range, description].filter(Boolean).join(" · ")),
      error = make("p", { class: "error", role: "alert", hidden: "" }),
      label = make("label", { for: id }, `${name} `, make("span", { class: "unit" }, unit ? `[${unit}]` : "")),
      now = make("span", acting, start === null ? "" : `now ${shown(variable, start)}`),
      row = make("div", { class: "row" }, field, make("button", { class: "act" }, "Set")),
      form = make(
        "form",
        { class: "change", "data-name": name.toLowerCase() },
        make("div", { class: "head" }, label, now),
        row,
      );
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
    if (isNumber(variable) && least !== null && most !== null && most - least < 1e9) {
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

  // -- events --------------------------------------------------------------------------------------
  const page = { view, run, sweep, refinement }[activity],
    events = new EventSource("events");
  let queue = Promise.resolve();
  events.onmessage = (event) => {
    queue = queue.then(async () => {
      state = JSON.parse(event.data);
      if (activity !== "view") showBar();
      await page.show();
      document.documentElement.dataset.live = state.phase ?? "view";
    });
  };
  events.onerror = () => {
    if (activity === "view")
      return view.desk?.warn("The command has ended. The data received so far remain on this page.");
    if (state && FINAL.includes(state.phase)) {
      events.close(); // the command has ended
      one("#report").hidden = true;
      return;
    }
    put(one("#phase"), "lost");
    one("#phase").className = "phase lost";
    tell("The command does not respond. The data received so far remain on this page.");
  };
})();
