"""Evaluation of a scenario's criteria on its results, and the figures of merit behind them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cosim.core.arrays import Array, far_beyond
from cosim.core.text import append_unit, display, displayed, is_difference, shown_unit
from cosim.core.times import roundings
from cosim.files.results import Results
from cosim.scenario.scenario import Scenario

DIGITS, MOST_DIGITS = 4, 17  # of a value and its limit; more where they would look the same


@far_beyond
def evaluate(scenario: Scenario, results: Results) -> list[dict[str, Any]]:
    """Return all criteria with value, limit, unit and outcome."""
    outcomes = []
    elapsed, close = results.time - results.time[0], roundings(results.time, scenario.step)
    for kind, _, criterion in scenario.goals:
        end = math.inf if criterion.until is None else criterion.until
        window = (elapsed >= criterion.after - close) & (elapsed <= end + close)
        t, signal = results.time[window], results[criterion.of][window]
        target = results[criterion.to][window] if isinstance(criterion.to, str) else np.full_like(signal, criterion.to)
        unit = results.units.get(criterion.of, "")
        value = math.inf  # An FMU ended the simulation before the window.
        if signal.size:
            unit = {"settling_time": "s", "effort": f"{unit}.s".lstrip(".")}.get(kind, unit)
            value = figure(kind, t, signal, target, criterion.band or 0.0)
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
    return outcomes


def sentence(outcome: dict[str, Any]) -> str:
    """Return the sentence on a criterion for the terminal."""
    verdict = "met" if outcome["met"] else "MISSED"
    sizes = [math.inf if outcome["value"] is None else outcome["value"], outcome["max"]]
    unit, factor = display(outcome["unit"])
    if not is_difference(outcome):
        unit, factor, sizes = shown_unit(outcome["unit"]), 1.0, [displayed(size, outcome["unit"]) for size in sizes]
    for digits in range(DIGITS, MOST_DIGITS):
        value, limit = (append_unit(f"{size * factor:.{digits}g}", unit) for size in sizes)
        if value != limit:
            break
    value = "never" if outcome["value"] is None else value
    window = "".join(f" {word} {outcome[word]:g} s" for word in ("after", "until") if outcome.get(word))
    return (
        f"{verdict}: {outcome['kind'].replace('_', ' ')} of {outcome['of']}{window} is {value}, at most {limit} allowed"
    )


def figure(kind: str, t: Array, signal: Array, target: Array, band: float) -> float:
    """Return a figure of merit of a signal at times `t` [s], in the signal's own unit, or in seconds.

    settling_time  time to the last sample outside target ± band: 0 if none is outside, inf if the signal ends outside
    overshoot      largest excursion beyond the final target, in the direction from the first sample to the target
    effort         time integral of the magnitude of the error [unit s]; the signal is held between samples
    """
    error = signal - target
    match kind:
        case "settling_time":
            outside = np.flatnonzero(np.abs(error) > band)
            if outside.size == 0:
                return 0.0
            return math.inf if outside[-1] == signal.size - 1 else float(t[outside[-1]] - t[0])
        case "overshoot":
            beyond = signal - target[-1]
            direction = -np.sign(beyond[0])
            return max(0.0, float(np.max(direction * beyond))) if direction else float(np.max(np.abs(beyond)))
        case "rms_error":
            return float(np.sqrt(np.mean(error**2)))
        case "final_error":
            return float(np.abs(error)[-1])
        case "effort":
            return float(np.sum(np.abs(error[:-1]) * np.diff(t)))
    return float(np.max(np.abs(error)))  # peak
