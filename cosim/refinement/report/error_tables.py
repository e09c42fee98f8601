"""Errors before and after a refinement, as tables and in a sentence."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.core.text import MISSING, append_unit, finer, percent, plain
from cosim.refinement.record import OTHER_HORIZONS, Part
from cosim.refinement.refinement import Refinement
from cosim.residuals.replay_sentences import horizon_name
from cosim.residuals.residual_statistics import remaining_excess

PARTS: Mapping[Part, str] = {"estimation": "Logs used for the fits", "validation": "Sealed logs"}
MAX_SHARE_OF_REPLAY, LEAST_REPLAYS = 0.3, 10  # share of the squared error in one replay of so many, worth a sentence
NOISE = 1.2  # times the floor; smaller errors are noise
FLOOR = "the error by sensor noise alone"
FREE_RUN_NAME = "free run"  # among the horizons of refine.json
NOTHING_TO_EXPLAIN, TOO_LITTLE = "nothing to explain", "too little to judge"  # in place of a remaining share
VARIANT_WORDS = {
    ("before", "after"): "before → refined",
    ("before", "nearest"): "the model → the nearest one",
    ("after",): "",
}


@dataclass(frozen=True)
class Marks:
    """Positions of errors and noise floor on a logarithmic ruler [%]."""

    before: float
    after: float
    floor: float
    low: float
    width: float


@dataclass(frozen=True)
class ErrorRow:
    """Errors of a channel as texts."""

    channel: str
    before: str
    recalibrated: str
    after: str
    floor: str
    excess: str
    of_recalibrated: str
    marks: Marks | None
    nearest: str = MISSING
    sensor_noise: str = MISSING
    free_run: str = MISSING


@dataclass(frozen=True)
class ErrorTable:
    """Errors on one set of logs.

    Attributes:
        nearest: Whether the rows have errors of the nearest model.
        free_run: Heading of the errors over a free run; "" without them.
    """

    title: str
    note: str
    rows: tuple[ErrorRow, ...]
    nearest: bool = False
    free_run: str = ""


@dataclass(frozen=True)
class HorizonTable:
    """Errors on a set of logs; each row has a channel's name and a text for each horizon."""

    title: str
    heading: str
    horizons: tuple[str, ...]
    rows: tuple[tuple[str, tuple[str, ...]], ...]


def units(r: Refinement) -> dict[str, str]:
    """Return the unit of each output."""
    return {q.name: q.unit for q in r.study.subject.outputs}


def error_size(value: float, unit: str, like: float) -> str:
    """Return an error in a unit for size `like`."""
    shown_unit, factor = finer(unit, like)
    return append_unit(plain(value * factor), shown_unit)


def horizon(r: Refinement) -> str:
    """Return the horizon as text: `2 s`, `a whole run`."""
    horizons = [played.horizon for _, played in r.evidence["before"]["estimation"]]
    return "a whole run" if not horizons or math.isinf(horizons[0]) else horizon_name(horizons[0])


def error_tables(r: Refinement) -> list[ErrorTable]:
    """Return a table for each set of logs."""
    error, tables = r.record["error"], []
    for part, title in PARTS.items():
        if part not in error["before"]:
            continue
        rows = tuple(_error_row(r, part, name) for name in error["before"][part])
        note = "Estimation logs." if part == "estimation" else "Opened once, at the end, to test the chosen model."
        note += "".join(f" {text}" for text in _concentration(r, part))
        heading = f"Free run, {VARIANT_WORDS[_variants(r)]}" if has_free_run(r) else ""
        has_nearest = any(row.nearest not in (MISSING, row.after) for row in rows)
        tables.append(ErrorTable(title, note, rows, has_nearest, heading.rstrip(", ")))
    return tables


def _concentration(r: Refinement, part: Part) -> Iterator[str]:
    """Yield a sentence for each channel whose squared error comes mostly from a single replay."""
    runs, model = r.evidence["after"][part], "refined model" if r.verdict.claimed else "model"
    for name in r.record["error"]["before"][part]:
        squares = []
        for log, played in runs:
            if name not in log.outputs:
                continue
            first = np.array(sorted(played.starts), dtype=np.intp)
            errors = np.nan_to_num(played.errors(log)[name]) ** 2
            sums = (float(part.sum()) for part in np.split(errors, first)[1:])
            squares += [(square, log, log.time[k]) for square, k in zip(sums, first, strict=True)]
        total = sum(square for square, *_ in squares)
        if len(squares) < LEAST_REPLAYS or not total > 0.0:
            continue
        worst, log, start = max(squares, key=lambda s: s[0])
        if worst > MAX_SHARE_OF_REPLAY * total:
            at = f"{log.path.name} from t = {start:.6g}\u00a0s"
            yield f"One replay, {at}, has {percent(worst / total)} of the {model}'s squared error of {name}."


def has_free_run(r: Refinement) -> bool:
    """Return whether errors over a free run exist beside the errors over the horizon."""
    return FREE_RUN_NAME in r.record.get("horizons", {}) and horizon(r) != "a whole run"


def _variants(r: Refinement) -> tuple[str, ...]:
    """Return the one or two models with horizons."""
    if r.verdict.claimed:
        return "before", "after"
    return ("before", "nearest") if r.record["error"].get("nearest") else ("after",)


def _free_run_text(r: Refinement, part: str, channel: str) -> str:
    """Return a channel's errors over a whole log."""
    errors = r.record["horizons"][FREE_RUN_NAME] if has_free_run(r) else {}
    sizes = [float((errors.get(name) or {}).get(part, {}).get(channel, math.nan)) for name in _variants(r)]
    return " → ".join(error_size(size, units(r).get(channel, ""), sizes[-1]) for size in sizes)


def horizon_table(r: Refinement) -> HorizonTable:
    """Return the errors over each horizon, shortest first.

    With a claim the models are before → refined, without a claim model → nearest model, or the model alone. Horizons
    shorter than a log's step are omitted.
    """
    part = decisive_part(r)
    errors = {seconds: r.record["horizons"][name] for name, seconds in OTHER_HORIZONS.items()}
    errors[r.study.subject.horizon] = r.record["error"]
    variants = _variants(r)
    words = VARIANT_WORDS[variants]
    heading = f"{words[:1].upper()}{words[1:]}, over" if words else "Over"

    def text(error: Mapping[str, Any], channel: str) -> str:
        sizes = [float(error[name][part].get(channel, math.nan)) for name in variants]
        return " → ".join(error_size(size, units(r).get(channel, ""), sizes[-1]) for size in sizes)

    ordered = sorted(h for h in errors if any(v is not None for v in errors[h]["before"][part].values()))
    rows = [(c, tuple(text(errors[h], c) for h in ordered)) for c in r.record["error"]["before"][part]]
    return HorizonTable(PARTS[part], heading, tuple(map(horizon_name, ordered)), tuple(rows))


def decisive_part(r: Refinement) -> Part:
    """Return the sealed logs, else the estimation logs."""
    return "validation" if "validation" in r.record["error"]["before"] else "estimation"


def _numbers(r: Refinement, part: str, name: str) -> list[float]:
    """Return errors before, recalibrated, after, floor and nearest; NaN if missing."""
    error, floors = r.record["error"], r.record["noise_floors"].get(part, {})
    parts = [error[v][part] for v in ("before", "recalibrated", "after")]
    parts += [floors, (error.get("nearest") or {}).get(part) or {}]
    return [float(of.get(name, math.nan)) for of in parts]


def _error_row(r: Refinement, part: str, name: str) -> ErrorRow:
    before, recalibrated, after, floor, _ = numbers = _numbers(r, part, name)
    *texts, nearest = (error_size(value, units(r).get(name, ""), after) for value in numbers)
    is_bare = not has_unknown_input(r)
    excess, of_recalibrated = (_share_text(error, after, floor, is_bare=is_bare) for error in (before, recalibrated))
    marks, noise = _marks(before, after, floor), float(r.record.get("sensor_noise", {}).get(name, math.nan))
    sensor_noise = error_size(noise, units(r).get(name, ""), after)
    free_run = _free_run_text(r, part, name)
    old, refitted, new, level = texts
    return ErrorRow(name, old, refitted, new, level, excess, of_recalibrated, marks, nearest, sensor_noise, free_run)


def _share_text(before: float, after: float, floor: float, *, is_bare: bool) -> str:
    """Return the excess error's remaining share as text.

    Args:
        is_bare: True if the floor is sensor noise alone. With an unknown input, it may include what is missing.
    """
    share = remaining_excess(before, after, floor)
    if math.isnan(share):
        return NOTHING_TO_EXPLAIN if before < NOISE * floor and is_bare else TOO_LITTLE if floor else MISSING
    return percent(max(0.0, share))


def _marks(before: float, after: float, floor: float) -> Marks | None:
    """Return positions on a logarithmic scale, or None."""
    good = [v for v in (before, after, floor) if math.isfinite(v) and v > 0]
    if len(good) < 3:
        return None
    logs = [math.log10(v) for v in good]
    middle, reach = 0.5 * (min(logs) + max(logs)), max(1.0, 1.1 * (max(logs) - min(logs)))
    at = [round(50 + 96 * (v - middle) / reach, 2) for v in logs]
    return Marks(at[0], at[1], at[2], min(at[:2]), abs(at[0] - at[1]))


def second_sentence(r: Refinement) -> str:
    """Return a sentence on the largest relative decrease of an error, on sealed logs if available."""
    part = decisive_part(r)
    where = (
        "On sealed logs"
        if part == "validation"
        else "On the logs used for the fits (no log was kept for a test at the end)"
    )
    name = leading_channel(r)
    if not name:
        return ""
    if r.verdict.claimed is None:
        return _unchanged_text(r, part, where)
    before, _, after, floor, _ = _numbers(r, part, name)
    sizes = [error_size(v, units(r).get(name, ""), after) for v in (before, after)]
    verb = "fell from" if after < before else "went from"
    lead = f"{where} the error of {name} over {horizon(r)} {verb} {sizes[0]} to {sizes[1]}"
    return f"{lead}{_floor_text(r, name, after, floor)}"


def has_unknown_input(r: Refinement) -> bool:
    """Return whether the noise floor contains an unknown input."""
    noise = r.verdict.floor_hypothesis(r.attribution).fit.noise
    return bool(np.any(noise.power > r.problem.noise.quiet))


def is_below_floor(r: Refinement) -> bool:
    """Return whether the model of the noise floor has an error below it."""
    error, floors = r.record["error"], r.record["noise_floors"]
    best = error["after"] if r.verdict.claimed else error.get("nearest") or error["after"]
    return any(0.0 < best[part].get(name, 0.0) < floor for part, of in floors.items() for name, floor in of.items())


def leading_channel(r: Refinement) -> str:
    """Return the channel with the largest relative decrease, or ""."""
    part = decisive_part(r)
    ratios = {}
    for name in r.record["error"]["before"][part]:
        before, _, after, *_ = _numbers(r, part, name)
        if before > 0 and after > 0 and math.isfinite(before + after):
            ratios[name] = after / before
    return min(ratios, key=lambda n: ratios[n], default="")


def _floor_text(r: Refinement, name: str, after: float, floor: float) -> str:
    """Return the end of a sentence: the noise floor beside the error, or a full stop without a floor.

    With an unknown input, the floor may include what is missing, so that no error is small beside it. The sensor noise
    and the error by the unknown input are then two numbers.
    """
    if not math.isfinite(floor):
        return "."
    unit, noise = units(r).get(name, ""), float(r.record.get("sensor_noise", {}).get(name, math.nan))
    if has_unknown_input(r):
        alone = f"sensor noise alone makes {error_size(noise, unit, noise)}, " if math.isfinite(noise) else ""
        rest = math.sqrt(max(0.0, floor**2 - (noise**2 if alone else 0.0)))
        return (
            f"; {alone}the estimated unknown input, which may include what is missing, {error_size(rest, unit, rest)}."
        )
    size, shown = (error_size(value, unit, after) for value in (floor, after))
    if size == shown:
        return f", which is the noise floor ({FLOOR})."
    return (
        f", below the noise floor ({FLOOR}) of {size}." if floor > after else f"; the noise floor ({FLOOR}) is {size}."
    )


def _unchanged_text(r: Refinement, part: str, where: str) -> str:
    """Return a sentence on the unchanged model's error farthest above its noise floor."""
    ratios = {}
    for name in r.record["error"]["before"][part]:
        *_, after, floor, _ = _numbers(r, part, name)
        if floor > 0 and after > 0:
            ratios[name] = after / floor
    if not (worst := max(ratios, key=lambda n: ratios[n], default="")):
        return ""
    *_, after, floor, nearest = _numbers(r, part, worst)
    sizes = [error_size(v, units(r).get(worst, ""), after) for v in (after, nearest)]
    comparison = f", the nearest model by {sizes[1]}" if nearest < after else ""
    lead = f"{where} the unchanged model misses {worst} by {sizes[0]} over {horizon(r)}{comparison}"
    return f"{lead}{_floor_text(r, worst, after, floor)}"
