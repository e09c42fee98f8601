"""Evaluation of a scenario's criteria, and their figures of merit, on results.

A figure of merit is a function of time `t` [s], a signal and its target, arrays of shape (samples,). The result is a
float in the signal's unit or in seconds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from cosim.core.arrays import Array, far_beyond
from cosim.core.text import append_unit, display, displayed, is_difference, shown_unit
from cosim.core.times import roundings
from cosim.credibility.validity import Validity
from cosim.files.results import Results
from cosim.scenario.scenario import Scenario

OUTSIDE = "time_outside_logs"  # of a component, the outcome of the criterion `valid`
USUAL_DIGITS, MAX_DIGITS = 4, 17  # of a value and its limit; more where they would look the same


@far_beyond
def evaluate(scenario: Scenario, results: Results, validity: Mapping[str, Validity]) -> list[dict[str, Any]]:
    """Return a mapping with value, limit, unit and outcome for each criterion.

    Args:
        validity: Component → validity of the run, for FMUs with a record of credibility.
    """
    outcomes = []
    elapsed, close = results.time - results.time[0], roundings(results.time, scenario.step)
    for kind, _, criterion in scenario.goals:
        end = math.inf if criterion.until is None else criterion.until
        window = (elapsed >= criterion.after - close) & (elapsed <= end + close)
        t, signal = results.time[window], results[criterion.of][window]
        target = results[criterion.to][window] if isinstance(criterion.to, str) else np.full_like(signal, criterion.to)
        unit = results.units.get(criterion.of, "")
        match kind:
            case _ if not signal.size:  # an FMU ended the simulation before the evaluated interval
                value = math.inf
            case "settling_time":
                value, unit = settling_time(t, signal, target, criterion.band or 0.0), "s"
            case "effort":
                size = np.abs(signal - target)  # held between samples
                value, unit = float(np.sum(size[:-1] * np.diff(t))), f"{unit}.s".lstrip(".")
            case "peak":
                value = float(np.max(np.abs(signal - target)))
            case _:
                figures = {"overshoot": overshoot, "rms_error": rms_error, "final_error": final_error}
                value = figures[kind](signal, target)
        outcomes.append(
            {
                "kind": kind,
                **criterion.model_dump(exclude_defaults=True, exclude={"max"}),
                "value": value if math.isfinite(value) else None,
                "max": criterion.max,
                "unit": unit,
                "met": bool(value <= criterion.max),
            }
        )
    for _, _, goal in scenario.valid_goals:
        entry = validity.get(goal.of, {})
        share = None if entry.get("missing") else entry.get("share")  # unknown without a coordinate
        outside = None if share is None else 100.0 * (1.0 - share)
        limits = {"value": outside, "max": 100.0 * (1.0 - goal.min), "unit": "%"}
        outcomes.append({"kind": OUTSIDE, "of": goal.of, **limits, "met": share is not None and share >= goal.min})
    return outcomes


def sentence(outcome: dict[str, Any]) -> str:
    """Return a sentence on the outcome of a criterion, for the terminal."""
    verdict = "met" if outcome["met"] else "MISSED"
    sizes = [math.inf if outcome["value"] is None else outcome["value"], outcome["max"]]
    unit, factor = display(outcome["unit"])
    if not is_difference(outcome):
        unit, factor, sizes = shown_unit(outcome["unit"]), 1.0, [displayed(size, outcome["unit"]) for size in sizes]
    for digits in range(USUAL_DIGITS, MAX_DIGITS):
        value, limit = (append_unit(f"{size * factor:.{digits}g}", unit) for size in sizes)
        if value != limit:
            break
    value = "never" if outcome["value"] is None else value
    window = "".join(f" {word} {outcome[word]:g} s" for word in ("after", "until") if outcome.get(word))
    return (
        f"{verdict}: {outcome['kind'].replace('_', ' ')} of {outcome['of']}{window} is {value}, at most {limit} allowed"
    )


def settling_time(t: Array, signal: Array, target: Array | float, band: float) -> float:
    """Return the time [s] to the last sample outside `target ± band`.

    The time is 0 if no sample is outside the band, and inf if the last sample is outside.
    """
    outside = np.flatnonzero(np.abs(signal - target) > band)
    if outside.size == 0:
        return 0.0
    if outside[-1] == signal.size - 1:
        return float("inf")
    return float(t[outside[-1]] - t[0])


def overshoot(signal: Array, target: Array | float) -> float:
    """Return the largest excursion beyond the final target, in the direction from the first sample to the target."""
    final = float(np.broadcast_to(target, signal.shape)[-1])
    direction = np.sign(final - signal[0])
    return max(0.0, float(np.max(direction * (signal - final)))) if direction else float(np.max(np.abs(signal - final)))


def rms_error(signal: Array, target: Array | float) -> float:
    """Return the root mean square of `signal - target`."""
    return float(np.sqrt(np.mean((signal - target) ** 2)))


def final_error(signal: Array, target: Array | float) -> float:
    """Return the absolute error at the last sample."""
    return float(np.abs(signal - target)[-1])
