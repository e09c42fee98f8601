"""Sentences about the craft in a run."""

from __future__ import annotations

import math

import numpy as np

from cosim.core.text import amount, length, percent
from fmus.report.figures_of_run import belief, inside_band, saturation
from fmus.report.lines import QUANTITIES
from fmus.report.roles import SIDES, Craft

SYMBOLS = {quantity.name: quantity.symbol for quantity in QUANTITIES}


def belief_sentence(craft: Craft) -> str | None:
    """Warn if only the estimate has settled."""
    end = belief(craft)
    if end is None or not end.wanders:
        return None
    sentences = [
        "The estimator believes it has settled; the craft has not.",
        f"At the end of the run x̂ lay {length(end.estimated)} from its target and the craft {length(end.true)}.",
    ]
    if craft.estimate("x") is None:
        sentences.append(
            "Heading, yaw rate and acceleration carry no information about the position: x is unobservable, and its"
            " error is not corrected."
        )
    if end.sigma > 0:
        outside = end.apart > 2 * end.sigma
        verdict = "outside" if outside else "within"
        sentences.append(f"That is {verdict} the ±2σ band of the estimator, ±{length(2 * end.sigma)} by then.")
    return " ".join(sentences)


def integral_sentence(craft: Craft) -> str | None:
    """Return the effect of integral control on the position."""
    if craft.estimate("x_integral") is None:
        return None
    x, target = craft.signal("x"), craft.reference("x")
    if x is None or target is None or not (good := np.isfinite(x) & np.isfinite(target)).any():
        return None
    last = good & (craft.run.time >= craft.run.time[-1] - 1.0)
    off = length(abs(float(np.mean((x - target)[last]))))
    error = f"Over the last second the craft was on average {off} off its target."
    if craft.run.source(f"{craft.estimator}.fix") is not None:
        return f"The controller integrates the error of the measured position, so that none remains. {error}"
    return (
        "The controller integrates the error of x, but nothing measures x: it integrates the error of its own estimate."
        " An accelerometer does not feel gravity on a tilted table, so the error of such a push remains."
        f" {error} Fixes on x_meas and fix cure that."
    )


def band_sentence(craft: Craft) -> str | None:
    """Return the shares of rows within the estimator's ±2σ band."""
    parts = []
    for variable in ("x", "psi"):
        share = inside_band(craft, variable)
        if math.isfinite(share):
            parts.append(f"{SYMBOLS[variable]} lay within ±2σ of its estimate for {percent(share)} of the rows")
    return f"{', '.join(parts)}; of a consistent filter about 95 % are." if parts else None


def motion_sentence(craft: Craft, called: str) -> str:
    """Return the distance travelled, the displacement and the turn."""
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
    """Return the saturation of the tilts."""
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
