"""Sensor noise of a craft at rest, eqs 5.44-5.46.

The thesis uses the variance about the mean. The variance about a straight line is given too, so that drift does not
count as noise; its interval accounts for correlated rows.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import numpy as np

from cosim.base.arrays import Array, Rows
from cosim.base.errors import Fault
from cosim.logs.log import Log
from cosim.model import Model
from cosim.storage.yaml_file import YamlFile
from plant.identification.estimates import Estimate, Figure, Result

FEWEST = 50  # rows: below, the 95 % interval of a variance spans more than 0.7 to 1.55 of it
DRIFTS = 1.1  # ratio to the variance about a line from which a mean hides a drift
MOVING = 5.0  # standard deviations between the halves of a log beyond which it was not at rest
AT_ENDS = 0.05  # share of rows at the extreme values beyond which a sensor is saturated
SLOW = 0.05  # share of the variance in row-to-row steps of a slow swing; 1 for white noise
Window = tuple[float, float] | None


def noise(logs: Sequence[Log], model: Model, window: Window = None) -> Result:
    """Return the variance of every output measured at rest."""
    units = {q.name: q.unit for q in model.outputs}
    names = [q.name for q in model.outputs if any(q.name in log.outputs for log in logs)]
    estimates, notes, figures = [], list[str](), list[Figure]()
    for name in names:
        parts = [(log.time[rows], log.outputs[name][rows]) for log, rows in _rows(logs, name, window)]
        estimate = variance(name, units[name], parts)
        estimates.append(estimate)
        if estimate.thesis > DRIFTS * estimate.value:
            share = estimate.thesis / estimate.value
            notes.append(f"{name} drifts: its variance about the mean is {share:.3g} times that about a straight line")
        time, values = parts[0]
        figures.append(Figure(f"{name} at rest", "time [s]", units[name], [("measured", time, values, "true")]))
    return Result("rest", estimates, notes, figures)


def variance(name: str, unit: str, parts: Sequence[tuple[Array, Array]]) -> Estimate:
    """Return the pooled S² of eq 5.44, and the variance about a line with its 95 % χ² interval."""
    from scipy import stats

    rows = sum(v.size for _, v in parts)
    about_mean = sum(float(np.sum((v - v.mean()) ** 2)) for _, v in parts) / (rows - len(parts))
    left = [v - np.polyval(np.polyfit(t - t.mean(), v, 1), t - t.mean()) for t, v in parts]
    freedom = rows - 2 * len(parts)
    about_line = sum(float(np.sum(r**2)) for r in left) / freedom
    # correlated rows count as fewer: for squares, 1 + 2·Σρ² (Bartlett)
    follows = 1.0 + 2.0 * sum(_correlation(left, lag) ** 2 for lag in range(1, 6))
    free = max(2.0, freedom / follows)
    low, high = (free * about_line / float(stats.chi2.ppf(p, free)) for p in (0.975, 0.025))
    spread, origin = about_line * float(np.sqrt(2.0 / free)), f"variance of {rows} rows at rest (5.44)"
    return Estimate(name, squared(unit), about_mean, about_line, low, high, spread, 0.0, len(parts), origin)


def squared(unit: str) -> str:
    """Square a unit, `m/s2` → `m2/s4`."""
    return re.sub(r"([^\W\d]+)(\d*)", lambda part: part[1] + str(2 * int(part[2] or 1)), unit) or "1"


def rest_faults(yaml: YamlFile, logs: Sequence[Log], window: Window) -> Iterator[Fault]:
    """Yield faults of short or moving logs."""
    if window is not None and window[0] >= window[1]:
        yield yaml.fault(("rest", "window"), f"{window[0]:g} … {window[1]:g} s is empty; write its start, then its end")
        return
    for log in logs:
        for name, values in log.outputs.items():
            chosen = next(iter(_rows([log], name, window)))[1]
            if chosen.size < FEWEST:
                told = f"{chosen.size} rows of {name} at rest, and it takes {FEWEST}; log longer (the thesis took 20 s)"
                yield Fault(log.path, 0, 0, told)
                continue
            first, last = np.array_split(values[chosen], 2)
            noise_ = float(np.std(np.diff(values[chosen]))) / np.sqrt(2.0)
            if reason := _unusable(values[chosen]):
                yield Fault(log.path, 0, 0, f"{name} {reason}; choose a window, or leave the log out")
                continue
            if abs(last.mean() - first.mean()) > MOVING * max(noise_, 1e-300) and noise_ > 0.0:
                told = f"{name} moves by {last.mean() - first.mean():.3g} from the first half to the second"
                yield Fault(log.path, 0, 0, f"{told}: not at rest; choose a window, or leave the log out")


def _unusable(values: Array) -> str:
    """Return the reason against rows, or ""."""
    low, high = float(values.min()), float(values.max())
    if low == high:
        return f"is {low:g} in every row: a dead channel"
    ends = float(np.mean((values == low) | (values == high)))
    if ends > AT_ENDS:
        return f"is {low:g} or {high:g} in {ends:.0%} of its rows: saturated, or coarser than its noise"
    steps, spread = float(np.mean(np.diff(values) ** 2)) / 2.0, float(np.var(values))
    if steps < SLOW * spread and _turns(values) > 2:
        return f"swings slowly, {spread / steps:.3g} times the variance from row to row: not at rest"
    return ""


def _turns(values: Array) -> int:
    """Return the number of smoothed mean crossings."""
    smooth = np.convolve(values - values.mean(), np.ones(9) / 9, "valid")
    return int(np.sum(smooth[1:] * smooth[:-1] < 0.0))


def _rows(logs: Sequence[Log], name: str, window: Window) -> Iterator[tuple[Log, Rows]]:
    low, high = window or (-np.inf, np.inf)
    for log in logs:
        if name in log.outputs:
            inside = (log.time >= low - 1e-9) & (log.time <= high + 1e-9) & np.isfinite(log.outputs[name])
            yield log, np.flatnonzero(inside)


def _correlation(parts: Sequence[Array], lag: int) -> float:
    both = sum(float(r[lag:] @ r[:-lag]) for r in parts)
    return both / max(sum(float(r @ r) for r in parts), 1e-300)
