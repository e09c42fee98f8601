// Draws the crafts from above, and moves them, their ghosts, trails and dials to the moment that the page's script tells.
/* global one, all, make, put, axis, roundStep */
(() => {
  "use strict";
  let between,
    series,
    bodies = null;

  // An arrow along the craft's axis, forward up, in millimetres.
  function arrow(reach) {
    if (!(Math.abs(reach) >= 8)) return "";
    const tip = -reach,
      barb = tip + Math.sign(reach) * Math.min(34, Math.abs(reach));
    return `M0 0V${tip.toFixed(0)}M-20 ${barb.toFixed(0)}L0 ${tip.toFixed(0)}L20 ${barb.toFixed(0)}`;
  }
  // The pieces of a track, a piece for each row; rows without a pose break it.
  function piecesOf([us, vs]) {
    let open = false;
    return us.map((u, row) => {
      const isHere = u !== null && vs[row] !== null,
        piece = isHere ? `${open ? "L" : "M"}${u} ${vs[row]}` : "";
      open = isHere;
      return piece;
    });
  }
  const transform = ([u, v, a]) => `translate(${u.toFixed(1)} ${v.toFixed(1)}) rotate(${a.toFixed(2)})`;
  function place(element, track, row, share) {
    const pose = track.map((values) => between(values, row, share));
    if (pose.includes(null)) return null;
    element.setAttribute("transform", transform(pose));
    return pose;
  }

  // What does not move: grid, scale, tracks, dots at equal times.
  function drawMap({ box, crafts, few }) {
    const [left, top, width, height] = box,
      map = one(".map"),
      across = axis(-(left + width) / 1000, -left / 1000, 6).ticks,
      up = axis(-(top + height) / 1000, -top / 1000, 4).ticks,
      labels = (ticks, side, shift) =>
        ticks.map((t) => make("span", { style: `${side}:${(100 * shift(t.at)).toFixed(2)}%` }, t.label));
    one(".grid", map).append(
      ...up.map((t) => make("path", { d: `M${left} ${top + height * (1 - t.at)}h${width}` })),
      ...across.map((t) => make("path", { d: `M${left + width * (1 - t.at)} ${top}v${height}` })),
    );
    const inner = (ticks, low, high) => ticks.filter(({ at }) => at > low && at < high);
    one(".map-ticks.across").append(...labels(inner(across, 0.03, 0.97), "left", (at) => 1 - at));
    one(".map-ticks.up").append(...labels(inner(up, 0.1, 0.96), "bottom", (at) => at));
    const bar = roundStep(width / 8000),
      every = roundStep(Math.max(few.at(-1) - few[0], 1e-6) / 24);
    one(".scale-bar").style.width = `${(100000 * bar) / width}%`;
    put(one(".scale-bar span"), `${bar} m`);
    put(one("#marks"), `a dot every ${every} s`);
    if (crafts[0].tilt_right) put(one("#arrows"), `arrows: horizontal thrust, 10 cm = ${roundStep(crafts[0].force)} N`);
    return crafts.map((entry, index) => {
      const group = all(".body", map)[index],
        pieces = Object.fromEntries(
          ["true", "estimate", "reference"].filter((k) => entry[k]).map((k) => [k, piecesOf(entry[k])]),
        );
      for (const [name, path] of Object.entries(pieces)) one(`.track.${name}`, group).setAttribute("d", path.join(""));
      const start = entry.true.map(([first]) => first);
      if (!start.includes(null)) one(".begin", group).setAttribute("transform", transform(start));
      for (let k = Math.ceil(few[0] / every - 1e-9); k * every <= few.at(-1) + 1e-9; k++) {
        const row = few.findLastIndex((t) => t <= k * every + 1e-9),
          share = (k * every - few[row]) / (few[row + 1] - few[row] || 1),
          [u, v] = entry.true.map((values) => between(values, row, share));
        if (u !== null && v !== null)
          one(".marks", group).append(make("path", { d: `M${u.toFixed(0)} ${v.toFixed(0)}h0` }));
      }
      const dials = one(`[data-dials="${index}"]`);
      return { entry, group, pieces: pieces.true, dials, scale: 100 / roundStep(crafts[0].force) };
    });
  }

  function drawBody({ entry, group, pieces, dials, scale }, row, share, nearest) {
    const at = place(one(".craft", group), entry.true, row, share);
    if (entry.estimate) place(one(".ghost", group), entry.estimate, row, share);
    const rest = at && pieces[row] ? `L${at[0].toFixed(0)} ${at[1].toFixed(0)}` : "";
    one(".trail", group).setAttribute("d", pieces.slice(0, row + 1).join("") + rest);
    for (const side of ["right", "left"]) {
      if (!entry["tilt_" + side]) continue;
      const force = between(entry["force_" + side], row, share),
        tilt = between(entry["tilt_" + side], row, share);
      one(`.arrow.${side}`, group).setAttribute("d", force === null ? "" : arrow(force * scale));
      if (tilt === null || !dials) continue;
      one(`[data-tilt="${side}"]`, dials).setAttribute("transform", `rotate(${tilt.toFixed(2)})`);
      const exact = series[entry[`tilt_${side}_key`]];
      put(one(`[data-tilt-text="${side}"]`, dials), exact.text(exact.v[nearest]) + "°");
    }
  }

  document.addEventListener("moment", ({ detail }) => {
    ({
      between,
      data: { series },
    } = detail);
    bodies ??= drawMap(detail.data);
    const [row, share] = detail.locate(detail.now, detail.data.few);
    for (const body of bodies) drawBody(body, row, share, detail.nearest);
  });
})();
