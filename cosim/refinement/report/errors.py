"""Errors before and after a refinement, as tables and in a sentence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from cosim.core.text import MISSING, append_unit, finer, percent, plain
from cosim.refinement.record import OTHER_HORIZONS, Part
from cosim.refinement.refinement import Refinement
from cosim.report.html_tables import Row
from cosim.residuals.replay_sentences import horizon_name
from cosim.residuals.residual_statistics import remaining_excess

PARTS: Mapping[Part, str] = {"estimation": "Logs used for the fits", "validation": "Sealed logs"}
MAX_SHARE_OF_REPLAY, LEAST_REPLAYS = 0.3, 10  # share of the squared error in one replay of so many, worth a sentence
NOISE = 1.2  # times the floor; smaller errors are noise
FLOOR = "the error by sensor noise alone"
NOTHING_TO_EXPLAIN, TOO_LITTLE = "nothing to explain", "too little to judge"  # in place of a remaining share


def error_size(r: Refinement, channel: str, value: float, like: float) -> str:
    """Return an error of a channel in a unit for size `like`."""
    unit = next((q.unit for q in r.study.subject.outputs if q.name == channel), "")
    shown_unit, factor = finer(unit, like)
    return append_unit(plain(value * factor), shown_unit)


def horizon(r: Refinement) -> str:
    """Return the horizon as text: `2 s`, `a whole run`."""
    horizons = [played.horizon for _, played in r.evidence["before"]["estimation"]]
    return "a whole run" if not horizons or math.isinf(horizons[0]) else horizon_name(horizons[0])


def has_free_run(r: Refinement) -> bool:
    """Return whether errors over a free run exist beside the errors over the horizon."""
    return "free run" in r.record.get("horizons", {}) and horizon(r) != "a whole run"


def has_unknown_input(r: Refinement) -> bool:
    """Return whether the noise floor contains an unknown input."""
    noise = (r.verdict.delivered or r.verdict.base).fit.noise
    return bool(np.any(noise.power > r.problem.noise.quiet))


def decisive_part(r: Refinement) -> Part:
    """Return the sealed logs, else the estimation logs."""
    return "validation" if "validation" in r.record["error"]["before"] else "estimation"


def error_tables(r: Refinement) -> list[dict[str, Any]]:
    """Return a table for each set of logs, its rows with the errors of a channel as texts."""
    error, tables, free_run = r.record["error"], [], ""
    if has_free_run(r):
        free_run = f"Free run, {_compared(r)[1]}".rstrip(", ")
    for part, title in PARTS.items():
        if part not in error["before"]:
            continue
        rows = []
        for name in error["before"][part]:
            before, recalibrated, after, floor, nearest = _numbers(r, part, name)
            sizes = {"before": before, "recalibrated": recalibrated, "after": after, "floor": floor, "nearest": nearest}
            sizes["sensor_noise"] = float(r.record.get("sensor_noise", {}).get(name, math.nan))
            row: dict[str, Any] = {key: error_size(r, name, size, after) for key, size in sizes.items()}
            row |= {"channel": name, "marks": _marks(before, after, floor)}
            for key, size in (("excess", before), ("of_recalibrated", recalibrated)):
                share = remaining_excess(size, after, floor)
                row[key] = percent(max(0.0, share))
                if math.isnan(share):  # With an unknown input, the floor may include what is missing.
                    is_noise = size < NOISE * floor and not has_unknown_input(r)
                    row[key] = NOTHING_TO_EXPLAIN if is_noise else TOO_LITTLE if floor else MISSING
            if free_run:
                row["free_run"] = _errors_text(r, r.record["horizons"]["free run"], part, name)
            rows.append(row)
        note = "Estimation logs." if part == "estimation" else "Opened once, at the end, to test the chosen model."
        note += _concentration(r, part)
        has_nearest = any(row["nearest"] not in (MISSING, row["after"]) for row in rows)
        tables.append({"title": title, "note": note, "rows": rows, "nearest": has_nearest, "free_run": free_run})
    return tables


def _concentration(r: Refinement, part: Part) -> str:
    """Return a sentence for each channel whose squared error comes mostly from a single replay."""
    text, model = "", "refined model" if r.verdict.claimed else "model"
    for name in r.record["error"]["before"][part]:
        squares = []
        for log, played in r.evidence["after"][part]:
            if name in log.outputs:
                first = np.array(sorted(played.starts), dtype=np.intp)
                errors = np.nan_to_num(played.errors(log)[name]) ** 2
                sums = (float(rows.sum()) for rows in np.split(errors, first)[1:])
                squares += [(square, log, log.time[k]) for square, k in zip(sums, first, strict=True)]
        total = sum(square for square, *_ in squares)
        if len(squares) < LEAST_REPLAYS or not total > 0.0:
            continue
        worst, log, start = max(squares, key=lambda s: s[0])
        if worst > MAX_SHARE_OF_REPLAY * total:
            at = f"{log.path.name} from t = {start:.6g}\u00a0s"
            text += f" One replay, {at}, has {percent(worst / total)} of the {model}'s squared error of {name}."
    return text


def _compared(r: Refinement) -> tuple[tuple[str, ...], str]:
    """Return the one or two models with horizons, and two of them in words."""
    if r.verdict.claimed:
        return ("before", "after"), "before → refined"
    if r.record["error"].get("nearest"):
        return ("before", "nearest"), "the model → the nearest one"
    return ("after",), ""


def _errors_text(r: Refinement, error: Mapping[str, Any], part: str, channel: str) -> str:
    sizes = [float((error.get(name) or {}).get(part, {}).get(channel, math.nan)) for name in _compared(r)[0]]
    return " → ".join(error_size(r, channel, size, sizes[-1]) for size in sizes)


def horizon_table(r: Refinement) -> dict[str, Any]:
    """Return the errors over each horizon, shortest first; horizons shorter than a log's step are omitted."""
    part, words = decisive_part(r), _compared(r)[1]
    errors = {seconds: r.record["horizons"][name] for name, seconds in OTHER_HORIZONS.items()}
    errors[r.study.subject.horizon] = r.record["error"]
    ordered = sorted(h for h in errors if any(v is not None for v in errors[h]["before"][part].values()))
    rows = [(c, [_errors_text(r, errors[h], part, c) for h in ordered]) for c in r.record["error"]["before"][part]]
    heading = f"{words[:1].upper()}{words[1:]}, over" if words else "Over"
    return {"title": PARTS[part], "heading": heading, "horizons": [*map(horizon_name, ordered)], "rows": rows}


def _numbers(r: Refinement, part: str, name: str) -> list[float]:
    """Return errors before, recalibrated, after, floor and nearest; NaN if missing."""
    error, floors = r.record["error"], r.record["noise_floors"].get(part, {})
    parts = [error[v][part] for v in ("before", "recalibrated", "after")]
    parts += [floors, (error.get("nearest") or {}).get(part) or {}]
    return [float(of.get(name, math.nan)) for of in parts]


def _marks(before: float, after: float, floor: float) -> dict[str, float] | None:
    """Return positions of errors and noise floor on a logarithmic ruler [%], or None."""
    if not all(math.isfinite(size) and size > 0 for size in (before, after, floor)):
        return None
    logs = [math.log10(size) for size in (before, after, floor)]
    middle, reach = 0.5 * (min(logs) + max(logs)), max(1.0, 1.1 * (max(logs) - min(logs)))
    old, new, level = (round(50 + 96 * (v - middle) / reach, 2) for v in logs)
    return {"before": old, "after": new, "floor": level, "low": min(old, new), "width": abs(old - new)}


def leading_channel(r: Refinement) -> str:
    """Return the channel with the largest relative decrease, or ""."""
    part = decisive_part(r)
    ratios = {}
    for name in r.record["error"]["before"][part]:
        before, _, after, *_ = _numbers(r, part, name)
        if before > 0 and after > 0 and math.isfinite(before + after):
            ratios[name] = after / before
    return min(ratios, key=lambda n: ratios[n], default="")


def second_sentence(r: Refinement) -> str:
    """Return a sentence on the largest relative decrease of an error, on sealed logs if available.

    Without a claim, it is on the unchanged model's error farthest above its noise floor.
    """
    part, name = decisive_part(r), leading_channel(r)
    where = "On sealed logs"
    if part == "estimation":
        where = "On the logs used for the fits (no log was kept for a test at the end)"
    if not name:
        return ""
    if r.verdict.claimed is None:
        numbers = {n: _numbers(r, part, n) for n in r.record["error"]["before"][part]}
        ratios = {n: after / floor for n, (*_, after, floor, _) in numbers.items() if floor > 0 and after > 0}
        if not (name := max(ratios, key=lambda n: ratios[n], default="")):
            return ""
    before, _, after, floor, nearest = _numbers(r, part, name)
    first, shown, other, level = (error_size(r, name, v, after) for v in (before, after, nearest, floor))
    if r.verdict.claimed is None:
        comparison = f", the nearest model by {other}" if nearest < after else ""
        text = f"{where} the unchanged model misses {name} by {shown} over {horizon(r)}{comparison}"
    else:
        verb = "fell from" if after < before else "went from"
        text = f"{where} the error of {name} over {horizon(r)} {verb} {first} to {shown}"
    if not math.isfinite(floor):
        return f"{text}."
    if has_unknown_input(r):  # The floor may include what is missing, so that no error is small beside it.
        noise, alone = float(r.record.get("sensor_noise", {}).get(name, math.nan)), ""
        rest = floor
        if math.isfinite(noise):
            alone = f"sensor noise alone makes {error_size(r, name, noise, noise)}, "
            rest = math.sqrt(max(0.0, floor**2 - noise**2))
        by_input = error_size(r, name, rest, rest)
        return f"{text}; {alone}the estimated unknown input, which may include what is missing, {by_input}."
    if level == shown:
        return f"{text}, which is the noise floor ({FLOOR})."
    if floor > after:
        return f"{text}, below the noise floor ({FLOOR}) of {level}."
    return f"{text}; the noise floor ({FLOOR}) is {level}."


def error_words(r: Refinement, tables: list[dict[str, Any]]) -> list[Row]:
    """Return explanations of the columns of errors."""
    claimed, error = r.verdict.claimed is not None, r.record["error"]
    floor = "The error that sensor noise alone would cause."
    if has_unknown_input(r):
        floor = "The error that sensor noise and the estimated unknown input would cause. "
        floor += "The unknown input may include what is missing."
    best = error["after"] if claimed else error.get("nearest") or error["after"]
    floors = [(best[part].get(name, 0.0), f) for part, of in r.record["noise_floors"].items() for name, f in of.items()]
    if any(0.0 < size < level for size, level in floors):
        floor += " The floor is an estimate; some errors lie below it."
    words = [Row("Recalibrated", "The model with its own parameters fitted anew, nothing added.")]
    if tables[-1]["nearest"]:
        words.append(Row("Nearest", "The most probable model that predicts held-out logs no worse than the given one."))
    words.append(Row("Sensor noise", "Standard deviation of the noise of one reading, estimated from the logs."))
    words.append(Row("Noise floor", floor))
    if claimed:
        text = (
            "The part of the squared error above the noise floor that the refined model keeps, relative to the model "
            "before and to the model recalibrated."
        )
        shown = {row[key] for table in tables for row in table["rows"] for key in ("excess", "of_recalibrated")}
        if NOTHING_TO_EXPLAIN in shown:
            text += f" “{NOTHING_TO_EXPLAIN.capitalize()}”: before, the error was the noise floor."
        if TOO_LITTLE in shown:
            text += f" “{TOO_LITTLE.capitalize()}”: before, the error was below twice the noise floor."
        words.append(Row("Left of …", text))
    if has_free_run(r):
        words.append(Row("Free run", "The model alone from the first row to the last."))
    return words
