// Moves the craft, its ghost, its trail and its dials to the moment that the page's script tells.
(() => {
  "use strict";
  const one = (selector, root = document) => root.querySelector(selector);
  let between,
    series,
    bodies = null;

  // The same arrow the server draws: along the craft's axis, forward up, in millimetres.
  function arrow(reach) {
    if (!(Math.abs(reach) >= 8)) return "";
    const tip = -reach,
      barb = tip + Math.sign(reach) * Math.min(34, Math.abs(reach));
    return `M0 0V${tip.toFixed(0)}M-20 ${barb.toFixed(0)}L0 ${tip.toFixed(0)}L20 ${barb.toFixed(0)}`;
  }

  // Rows without a pose break the trail, as they break the path the server drew.
  function trailPieces(entry) {
    let open = false;
    return entry.u.map((u, row) => {
      if (u == null || entry.v[row] == null) {
        open = false;
        return "";
      }
      const piece = `${open ? "L" : "M"}${u} ${entry.v[row]}`;
      open = true;
      return piece;
    });
  }

  const bodiesOf = (data) =>
    data.crafts.map((entry, index) => ({
      entry,
      craft: one(`[data-craft="${index}"]`),
      ghost: one(`[data-ghost="${index}"]`),
      trail: one(`[data-trail="${index}"]`),
      dials: one(`[data-dials="${index}"]`),
      pieces: trailPieces(entry),
    }));

  function place(element, entry, prefix, row, share) {
    const [u, v, a] = ["u", "v", "a"].map((name) => between(entry[prefix + name], row, share, 0));
    if (u == null || v == null || a == null) return null;
    element.setAttribute("transform", `translate(${u.toFixed(1)} ${v.toFixed(1)}) rotate(${a.toFixed(2)})`);
    return [u, v];
  }

  function drawBody(body, row, share, nearest) {
    const { entry } = body;
    const at = place(body.craft, entry, "", row, share);
    if (body.ghost && entry.gu) place(body.ghost, entry, "g", row, share);
    body.trail.setAttribute(
      "d",
      body.pieces.slice(0, row + 1).join("") +
        (at && body.pieces[row] ? `L${at[0].toFixed(0)} ${at[1].toFixed(0)}` : ""),
    );
    for (const side of ["right", "left"]) {
      if (!entry["tilt_" + side]) continue;
      const force = between(entry["force_" + side], row, share, 0),
        tilt = between(entry["tilt_" + side], row, share, 0);
      one(`[data-arrow="${side}"]`, body.craft).setAttribute("d", force == null ? "" : arrow(force * entry.scale));
      if (tilt == null || !body.dials) continue;
      one(`[data-tilt="${side}"]`, body.dials).setAttribute("transform", `rotate(${tilt.toFixed(2)})`);
      const exact = series[entry[`tilt_${side}_key`]];
      one(`[data-tilt-text="${side}"]`, body.dials).textContent = exact.text(exact.v[nearest]) + "°";
    }
  }

  document.addEventListener("moment", ({ detail }) => {
    ({
      between,
      data: { series },
    } = detail);
    bodies ??= bodiesOf(detail.data);
    const [row, share] = detail.locate(detail.now, detail.data.few);
    for (const body of bodies) drawBody(body, row, share, detail.nearest);
  });
})();
