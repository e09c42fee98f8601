"""Evaluation of a scenario's criteria on its results."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cosim.base.arrays import far_beyond
from cosim.base.times import roundings
from cosim.scenario.scenario import Criterion, Scenario
from cosim.simulation import metrics
from cosim.storage.results import Results

DIGITS, MOST_DIGITS = 4, 17  # of a value and its limit; more where they would look the same


@far_beyond
def evaluate(scenario: Scenario, results: Results) -> list[dict[str, Any]]:
    """Return all criteria with value, limit, unit and outcome."""
    return [_evaluate(kind, criterion, results, scenario.step) for kind, _, criterion in scenario.goals]


def missed_tolerance(results: Results) -> list[dict[str, Any]]:
    """Return the tolerance of controlled steps as a missed criterion, if shortest steps have a larger error."""
    steps = results.details.get("steps", {})
    if not (missed := steps.get("missed")):
        return []
    limits = {"value": missed["error"], "max": steps["tolerance"], "unit": ""}
    return [{"kind": "step_error", "of": missed["signal"], **limits, "met": False}]


def _evaluate(kind: str, criterion: Criterion, results: Results, step: float) -> dict[str, Any]:
    end = math.inf if criterion.until is None else criterion.until
    elapsed = results.time - results.time[0]
    close = roundings(results.time, step)
    window = (elapsed >= criterion.after - close) & (elapsed <= end + close)
    t, signal = results.time[window], results[criterion.of][window]
    target = results[criterion.to][window] if isinstance(criterion.to, str) else np.full_like(signal, criterion.to)
    unit = results.units.get(criterion.of, "")
    match kind:
        case _ if not signal.size:  # An FMU ended the simulation before the window.
            value = math.inf
        case "settling_time":
            value, unit = metrics.settling_time(t, signal, target, criterion.band or 0.0), "s"
        case "effort":
            value, unit = metrics.effort(t, signal - target), f"{unit}.s".lstrip(".")
        case "peak":
            value = metrics.peak(signal - target)
        case _:
            value = getattr(metrics, kind)(signal, target)
    return {
        "kind": kind,
        **criterion.model_dump(exclude_defaults=True, exclude={"max"}),
        "value": value if math.isfinite(value) else None,
        "max": criterion.max,
        "unit": unit,
        "met": bool(value <= criterion.max),
    }


def sentence(outcome: dict[str, Any]) -> str:
    """Return the sentence on a criterion for the terminal."""
    verdict = "met" if outcome["met"] else "MISSED"
    sizes = math.inf if outcome["value"] is None else outcome["value"], outcome["max"]
    for digits in range(DIGITS, MOST_DIGITS):
        value, limit = (f"{size:.{digits}g} {outcome['unit']}".rstrip() for size in sizes)
        if value != limit:
            break
    value = "never" if outcome["value"] is None else value
    window = "".join(f" {word} {outcome[word]:g} s" for word in ("after", "until") if outcome.get(word))
    return (
        f"{verdict}: {outcome['kind'].replace('_', ' ')} of {outcome['of']}{window} is {value}, at most {limit} allowed"
    )
