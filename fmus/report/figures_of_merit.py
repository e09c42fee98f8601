"""Tables of the craft: step responses, errors, effort."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cosim.core.text import MISSING, amount, length, percent
from cosim.report.html_tables import Grid, Row
from cosim.simulation.report.recorded import Run, mappings, number
from fmus.report.account import SYMBOLS
from fmus.report.figures_of_run import BAND, effort, error_rms, responses, saturation
from fmus.report.lines import QUANTITIES
from fmus.report.roles import SIDES, Craft

SI = {"x": "m", "psi": "rad", "vx": "m/s", "psi_dot": "rad/s"}
MAX_RESPONSES = 16
SETTLING = "settling_time"  # kind of criterion


def tiles(run: Run, crafts: Sequence[Craft]) -> list[Row]:
    """Return the key figures of the first craft."""
    rows: list[Row] = []
    for variable in ("x", "psi"):
        answers = responses(crafts[0], variable) if crafts and not run.has_failed else []
        if answers:
            unit = SI[variable]
            by_step = Row(
                f"Settling of {SYMBOLS[variable]}",
                _settling(answers[-1].settling, unit),
                f"last step, ±{BAND:g} {unit}",
            )
            rows.append(_settling_of_criterion(run, crafts[0], variable) or by_step)
    if rows and (answers := responses(crafts[0], "x")):
        error = length(answers[-1].final).replace("less than", "<")
        rows.append(Row("Final error of x", error, "craft against reference"))
    shares = [saturation(craft, side) for craft in crafts[:1] for side in SIDES]
    if shares and all(map(math.isfinite, shares)):
        rows.append(Row("Tilt at its limit", percent(max(shares)), "of the time, busier side"))
    return rows


def _settling_of_criterion(run: Run, craft: Craft, variable: str) -> Row | None:
    """Return the settling time of a signal's last criterion."""
    column = f"{craft.name}.{variable}"
    criteria = [c for c in mappings(run.manifest.get("criteria")) if (c.get("kind"), c.get("of")) == (SETTLING, column)]
    if not criteria:
        return None
    value, band = criteria[-1].get("value"), amount(number(criteria[-1].get("band")), SI[variable], None)
    time = amount(number(value), "s") if value is not None else f"not within ±{band}"
    return Row(f"Settling of {SYMBOLS[variable]}", time, f"last criterion, ±{band}")


def _settling(value: float, unit: str) -> str:
    """Return a settling time as text."""
    if math.isnan(value):
        return MISSING
    return amount(value, "s") if math.isfinite(value) else f"not within ±{BAND:g}\xa0{unit}"


def response_rows(craft: Craft) -> list[dict[str, str]]:
    """Return the last responses of x and ψ as text."""
    answers = sorted((r for v in ("x", "psi") for r in responses(craft, v)), key=lambda r: (r.time, r.variable != "x"))
    rows = []
    for answer in answers[-MAX_RESPONSES:]:
        unit = SI[answer.variable]
        ramp = f", ramp of {amount(answer.ramp, 's', 2)}" if answer.ramp else ""
        step = f"{amount(answer.start, unit)} → {amount(answer.target, unit)}{ramp}"
        row = {"symbol": SYMBOLS[answer.variable], "time": amount(answer.time, "s"), "step": step}
        row |= {name: _settling(getattr(answer, name), unit) for name in ("settling", "believed")}
        rows.append(row | {name: amount(getattr(answer, name), unit, 2) for name in ("overshoot", "rms", "final")})
    return rows


def error_grid(craft: Craft) -> Grid | None:
    """Return the RMS errors of control and estimation."""
    rows = []
    for quantity in QUANTITIES:
        true, unit = craft.signal(quantity.name), SI[quantity.name]
        tracking = error_rms(true, craft.reference(quantity.name))
        estimation = error_rms(craft.estimate(f"{quantity.name}_hat"), true)
        if math.isfinite(tracking) or math.isfinite(estimation):
            rows.append((quantity.symbol, amount(tracking, unit), amount(estimation, unit)))
    return Grid("RMS errors", ("craft − reference", "estimate − craft"), tuple(rows)) if rows else None


def tilt_grid(craft: Craft) -> Grid | None:
    """Return effort and saturation of the tilts."""
    rows = []
    for side in SIDES:
        command = craft.command(f"tilt_{side}")
        good = np.abs(command[np.isfinite(command)]) if command is not None else np.zeros(0)
        if good.size:
            used = amount(effort(craft, side), "rad.s")
            rows.append((side, used, amount(float(good.max()), "rad"), percent(saturation(craft, side))))
    return Grid("Tilt commands", ("effort ∫|α| dt", "largest", "at its limit"), tuple(rows)) if rows else None
