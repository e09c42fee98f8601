"""Sensor noise of a craft at rest, eqs 5.44-5.46.

The thesis uses the variance about the mean. The variance about a straight line is given too, so that drift does not
count as noise; its interval accounts for correlated rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from cosim.base.arrays import Array, Rows
from cosim.base.errors import Fault
from cosim.base.units import square_unit
from cosim.logs.log import Log
from cosim.model import Model
from cosim.storage.yaml_file import YamlFile
from plant.identification import messages
from plant.identification.estimates import Estimate, Figure, Result

MIN_ROWS = 50  # rows: below, the 95 % interval of a variance spans more than 0.7 to 1.55 of it
DRIFTS = 1.1  # ratio to the variance about a line from which a mean hides a drift
MOVING = 5.0  # standard deviations between the halves of a log beyond which it was not at rest
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
            notes.append(messages.DRIFTING_OUTPUT(output=name, ratio=estimate.thesis / estimate.value))
        time, values = parts[0]
        figures.append(Figure(f"{name} at rest", "time [s]", units[name], [("measured", time, values, "true")]))
    return Result("rest", estimates, notes, figures)


def variance(name: str, unit: str, parts: Sequence[tuple[Array, Array]]) -> Estimate:
    """Return the pooled S² of eq 5.44, and the variance about a line with its 95 % χ² interval.

    Args:
        parts: Times and readings of each log.
    """
    from scipy import stats

    rows = sum(v.size for _, v in parts)
    about_mean = sum(float(np.sum((v - v.mean()) ** 2)) for _, v in parts) / (rows - len(parts))
    rests = [v - np.polyval(np.polyfit(t - t.mean(), v, 1), t - t.mean()) for t, v in parts]
    freedom = rows - 2 * len(parts)
    about_line = sum(float(np.sum(r**2)) for r in rests) / freedom
    # correlated rows count as fewer: for squares, 1 + 2·Σρ² (Bartlett)
    per_row = 1.0 + 2.0 * sum(_correlation(rests, lag) ** 2 for lag in range(1, 6))
    free = max(2.0, freedom / per_row)
    low, high = (free * about_line / float(stats.chi2.ppf(p, free)) for p in (0.975, 0.025))
    spread, origin = about_line * float(np.sqrt(2.0 / free)), f"variance of {rows} rows at rest (5.44)"
    return Estimate(name, square_unit(unit) or "1", about_mean, about_line, low, high, spread, 0.0, len(parts), origin)


def rest_faults(yaml: YamlFile, logs: Sequence[Log], window: Window) -> Iterator[Fault]:
    """Yield a fault for an empty window, and for each log that is too short or not at rest."""
    if window is not None and window[0] >= window[1]:
        yield yaml.fault(("rest", "window"), messages.EMPTY_WINDOW(start=window[0], end=window[1]))
        return
    for log in logs:
        for name in log.outputs:
            ((_, rows),) = _rows([log], name, window)
            if message := _reason_against(name, log.outputs[name][rows]):
                yield Fault(log.path, 0, 0, message)


def _reason_against(name: str, values: Array) -> str | None:
    """Return the message against an output's rows, or None."""
    if values.size < MIN_ROWS:
        return messages.TOO_FEW_ROWS_AT_REST(rows=values.size, output=name, least=MIN_ROWS)
    low, high = float(values.min()), float(values.max())
    if low == high:
        return messages.CONSTANT_OUTPUT(output=name, value=low)
    first, last = np.array_split(values, 2)
    change, noise_level = last.mean() - first.mean(), float(np.std(np.diff(values))) / np.sqrt(2.0)
    if abs(change) > MOVING * max(noise_level, 1e-300) and noise_level > 0.0:
        return messages.MOVING_OUTPUT(output=name, change=change)
    return None


def _rows(logs: Sequence[Log], name: str, window: Window) -> Iterator[tuple[Log, Rows]]:
    low, high = window or (-np.inf, np.inf)
    for log in logs:
        if name in log.outputs:
            inside = (log.time >= low - 1e-9) & (log.time <= high + 1e-9) & np.isfinite(log.outputs[name])
            yield log, np.flatnonzero(inside)


def _correlation(parts: Sequence[Array], lag: int) -> float:
    both = sum(float(r[lag:] @ r[:-lag]) for r in parts)
    return both / max(sum(float(r @ r) for r in parts), 1e-300)
