"""Errors before and after a refinement, as tables and in a sentence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from cosim.core.text import MISSING, append_unit, finer, percent, plain
from cosim.refinement.record import OTHER_HORIZONS, Part
from cosim.refinement.refinement import Refinement
from cosim.residuals.compare import horizon_name
from cosim.residuals.residual_statistics import FREE_RUN, remaining_excess

PARTS: Mapping[Part, str] = {"estimation": "Logs used for the fits", "validation": "Sealed logs"}
NOTES: Mapping[Part, str] = {
    "estimation": "Estimation logs.",
    "validation": "Opened once, at the end, to test the chosen model.",
}


def error_size(r: Refinement, channel: str, value: float, like: float) -> str:
    """Return an error of a channel in a unit for size `like`."""
    unit = next((q.unit for q in r.study.subject.outputs if q.name == channel), "")
    shown_unit, factor = finer(unit, like)
    return append_unit(plain(value * factor), shown_unit)


def horizon(r: Refinement) -> str:
    """Return the horizon as text: `2 s`, `a whole run`."""
    judged = r.study.subject.horizon
    return "a whole run" if judged == FREE_RUN else horizon_name(judged)


def has_unknown_input(r: Refinement) -> bool:
    """Return whether the noise floor contains an unknown input."""
    noise = (r.verdict.delivered or r.verdict.base).fit.noise
    return bool(np.any(noise.power > r.problem.noise.quiet))


def decisive_part(r: Refinement) -> Part:
    """Return the sealed logs, else the estimation logs."""
    return "validation" if "validation" in r.record["error"]["before"] else "estimation"


def _numbers(r: Refinement, part: str, name: str) -> dict[str, float]:
    """Return the errors of a channel by model, and its noise floor; NaN if missing."""
    error = r.record["error"]
    found = {v: (error.get(v) or {}).get(part, {}) for v in ("before", "recalibrated", "after", "nearest")}
    found["floor"] = r.record["noise_floors"].get(part, {})
    return {key: float(of.get(name, math.nan)) for key, of in found.items()}


def error_tables(r: Refinement) -> list[dict[str, Any]]:
    """Return a table for each set of logs, its rows with the errors of a channel as texts."""
    tables = []
    for part, title in PARTS.items():
        rows = []
        for name in r.record["error"]["before"].get(part, {}):
            sizes = _numbers(r, part, name)
            after, floor = sizes["after"], sizes["floor"]
            drawn = {key: sizes[key] for key in ("before", "after", "floor")}
            row: dict[str, Any] = {key: error_size(r, name, size, after) for key, size in sizes.items()}
            row["sensor_noise"] = error_size(r, name, r.record["sensor_noise"].get(name, math.nan), after)
            for key, model in (("excess", "before"), ("of_recalibrated", "recalibrated")):
                row[key] = percent(max(0.0, remaining_excess(sizes[model], after, floor)))
            largest = max(drawn.values()) if all(map(math.isfinite, drawn.values())) else 0.0
            marks = {key: size / largest for key, size in drawn.items()} if largest else None
            rows.append({**row, "channel": name, "marks": marks})
        has_nearest = any(row["nearest"] not in (MISSING, row["after"]) for row in rows)
        tables += [{"title": title, "note": NOTES[part], "rows": rows, "nearest": has_nearest}] if rows else []
    return tables


def horizon_table(r: Refinement) -> dict[str, Any]:
    """Return the errors over each horizon, shortest first; horizons shorter than a log's step are omitted."""
    part, models, words = decisive_part(r), ["after"], ""
    if r.verdict.claimed:
        models, words = ["before", "after"], "Before → refined, over"
    elif r.record["error"].get("nearest"):
        models, words = ["before", "nearest"], "The model → the nearest one, over"
    errors = {seconds: r.record["horizons"][name] for name, seconds in OTHER_HORIZONS.items()}
    errors[r.study.subject.horizon] = r.record["error"]
    ordered, rows = sorted(h for h in errors if errors[h]["before"][part]), []
    for channel in r.record["error"]["before"][part]:
        sizes = [[errors[h][model].get(part, {}).get(channel, math.nan) for model in models] for h in ordered]
        rows.append((channel, [" → ".join(error_size(r, channel, size, of[-1]) for size in of) for of in sizes]))
    horizons = [*map(horizon_name, ordered)]
    return {"title": PARTS[part], "heading": words or "Over", "horizons": horizons, "rows": rows}


def leading_channel(r: Refinement) -> str:
    """Return the channel with the largest error of the given model relative to the noise floor, or ""."""
    part = decisive_part(r)
    numbers = {name: _numbers(r, part, name) for name in r.record["error"]["before"][part]}
    ratios = {name: n["before"] / n["floor"] for name, n in numbers.items() if n["floor"] > 0.0}
    return max(ratios, key=lambda name: ratios[name], default=next(iter(numbers), ""))


def second_sentence(r: Refinement) -> str:
    """Return a sentence on the error farthest above its noise floor, on sealed logs if available."""
    part, name = decisive_part(r), leading_channel(r)
    where = "On sealed logs"
    if part == "estimation":
        where = "On the logs used for the fits (no log was kept for a test at the end)"
    if not name:
        return ""
    sizes = _numbers(r, part, name)
    shown = {key: error_size(r, name, size, sizes["after"]) for key, size in sizes.items()}
    verb = "fell" if sizes["after"] < sizes["before"] else "changed"
    text = f"{where} the error of {name} over {horizon(r)} {verb} from {shown['before']} to {shown['after']}"
    if r.verdict.claimed is None:
        text = f"{where} the unchanged model misses {name} by {shown['after']} over {horizon(r)}"
        text += f", the nearest model by {shown['nearest']}" if sizes["nearest"] < sizes["after"] else ""
    if math.isnan(sizes["floor"]):
        return f"{text}."
    cause = "sensor noise and the estimated unknown input" if has_unknown_input(r) else "sensor noise alone"
    return f"{text}; the noise floor (the error by {cause}) is {shown['floor']}."
