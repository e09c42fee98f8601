"""The run in words: each sentence is computed from the data and left out where it would not be true."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.report.judgement import belief, inside_band, saturation
from cosim.report.panels import QUANTITIES
from cosim.report.roles import SIDES, Craft, Run, mappings, number
from cosim.report.text import amount, counted, length, percent

SYMBOLS = {quantity.name: quantity.symbol for quantity in QUANTITIES}


@dataclass(frozen=True)
class Criterion:
    """A criterion of the scenario as the page tells it."""

    what: str
    value: str
    allowed: str
    margin: str
    met: bool


def criteria(run: Run) -> list[Criterion]:
    """The criteria of the manifest, as text."""
    return [_criterion(entry, run.unit(str(entry.get("of")))) for entry in mappings(run.manifest.get("criteria"))]


def _criterion(entry: Mapping[str, Any], unit_of_signal: str) -> Criterion:
    unit, value, bound = str(entry.get("unit") or ""), number(entry.get("value")), number(entry.get("max"))
    kind = str(entry.get("kind", "criterion"))
    met = bool(entry["met"]) if "met" in entry else value <= bound
    target = entry.get("to")
    parts = [f"{kind.replace('_', ' ')} of {entry.get('of', '?')}"]
    if target is not None:
        parts.append(f"to {target if isinstance(target, str) else amount(number(target), unit_of_signal, None)}")
    parts += [f"within ±{amount(number(entry['band']), unit_of_signal, None)}"] if "band" in entry else []
    parts += [f"{word} {amount(number(entry[word]), 's', None)}" for word in ("after", "until") if word in entry]
    shown = amount(value, unit) if math.isfinite(value) else ("not settled" if kind == "settling_time" else "none")
    left = bound - value
    margin = "" if not math.isfinite(left) else f"{amount(abs(left), unit)} {'left' if left >= 0 else 'over'}"
    allowed = f"≤ {amount(bound, unit, None)}" if math.isfinite(bound) else ""
    return Criterion(" ".join(parts), shown, allowed, margin, met)


def failed(run: Run) -> bool:
    """Whether the simulation stopped before its end."""
    return str(run.manifest.get("status") or "ok") != "ok"


def outcome(run: Run, judged: list[Criterion]) -> str:
    """The run in one or two plain sentences."""
    missed = [c for c in judged if not c.met]
    if failed(run):
        status = str(run.manifest["status"])
        reason = status.removeprefix("failed").lstrip(": ") or "no reason was recorded"
        return f"The simulation failed: {reason}. The rows before that are shown."
    if not judged:
        return "The run completed; the scenario sets no criteria."
    if not missed:
        return "The criterion was met." if len(judged) == 1 else f"All {counted(len(judged), 'criterion')} were met."
    verb = "was" if len(missed) == 1 else "were"
    first = missed[0]
    detail = f"{first.what}: {first.value}" + (f", allowed {first.allowed}" if first.allowed else "")
    which = detail if len(missed) == 1 else f"first, {detail}"
    return f"{len(missed)} of {counted(len(judged), 'criterion')} {verb} missed ({which})."


def belief_sentence(craft: Craft) -> str | None:
    """Said only where the data show it: the estimator has settled, the craft has not."""
    seen = belief(craft)
    if seen is None or not seen.wanders:
        return None
    sentences = [
        "The estimator believes it has settled; the craft has not.",
        f"At the end of the run x̂ lay {length(seen.estimated)} from its target and the craft {length(seen.true)}.",
    ]
    if craft.estimate("x") is None:
        sentences.append(
            "Heading, yaw rate and acceleration carry no information about position: x is unobservable, so this error"
            " is neither seen nor corrected."
        )
    if seen.sigma > 0:
        outside = seen.apart > 2 * seen.sigma
        verdict = "beyond even" if outside else "within"
        sentences.append(f"That is {verdict} the ±2σ the estimator itself admits, ±{length(2 * seen.sigma)} by then.")
    return " ".join(sentences)


def band_sentence(craft: Craft) -> str | None:
    """How honest the estimator's standard deviations were."""
    parts = []
    for variable in ("x", "psi"):
        share = inside_band(craft, variable)
        if math.isfinite(share):
            parts.append(f"{SYMBOLS[variable]} lay within ±2σ of its estimate for {percent(share)} of the rows")
    return f"{', '.join(parts)}; an honest filter gives about 95 %." if parts else None


def motion_sentence(craft: Craft, called: str) -> str:
    """Way travelled, and where the craft ended against where it began."""
    lines = [craft.run.results[f"{craft.name}.{name}"] for name in ("x_world", "y_world", "psi")]
    good = np.all(np.isfinite(lines), axis=0)
    if good.sum() < 2:
        return "Too few finite rows to tell a motion."
    x, y, psi = (line[good] for line in lines)
    way, gap = float(np.hypot(np.diff(x), np.diff(y)).sum()), math.hypot(x[-1] - x[0], y[-1] - y[0])
    turn = float(psi[-1] - psi[0])
    side = "left" if turn > 0 else "right"
    seconds = float(craft.run.time[good][-1] - craft.run.time[good][0])
    return (
        f"In {amount(seconds, 's')} {called} travelled {length(way)} and ended "
        f"{length(gap)} from where it began, turned {amount(abs(turn), 'rad', 2)} to the {side}."
    )


def tilt_sentence(craft: Craft) -> str | None:
    """Saturation in words."""
    limit, shares = craft.tilt_limit, [saturation(craft, side) for side in SIDES]
    if limit is None or not all(map(math.isfinite, shares)):
        return None
    at = f"±{amount(limit, 'rad')}"
    if max(shares) == 0:
        return f"No tilt command reached its limit of {at}."
    return (
        f"Tilt commands stood at their limit of {at} for {percent(shares[0])} of the time on the right, "
        f"{percent(shares[1])} on the left."
    )
