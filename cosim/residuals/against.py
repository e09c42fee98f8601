"""Comparison of a log with a replay, to find errors of clocks, units and signs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from cosim.base.arrays import Array
from cosim.base.text import amount, plain
from cosim.base.units import factor
from cosim.logs.finding import Finding
from cosim.logs.log import Log
from cosim.logs.unit_mistakes import SLOW, moving_part, other_unit
from cosim.residuals import messages
from cosim.residuals.residual_statistics import correlation_at_lags

LONGEST_DELAY = 0.5  # [s]
LIKE = 0.85  # correlation of a signal with its model beyond chance
TELLING = 0.6  # least correlation with the model for a delay estimate
REGULAR = "or, the motion being so regular, a wrong friction or inertia"
FASTER = 1.15  # ratio of mean frequencies from which fast changes are independent evidence


DIRECTIONS = {  # of a delay and its likely causes, for positive and other times
    True: ("trails", "a delay, a slower actuator"),
    False: ("leads", "a faster actuator, a command logged late"),
}


def delays(log: Log, model: Mapping[str, Array]) -> Iterator[Finding]:
    """Yield findings on channels with a delay of half a row or more; slow channels are too uncertain."""
    estimates = {n: d for n, y in log.outputs.items() if n in model and (d := delay(log, y, model[n])) is not None}
    fastest = max((d.frequency for d in estimates.values()), default=0.0)
    for name, (time, error, rho, frequency) in estimates.items():
        if frequency < 0.6 * fastest or abs(time) < max(4.0 * error, 0.4 * log.step):
            continue
        confirmed = _same_when_faster(log, log.outputs[name], model[name], estimates[name])
        if confirmed is False:
            continue
        serious, (direction, cause) = confirmed and abs(time) > log.step, DIRECTIONS[time > 0]
        message = (messages.DELAY if serious else messages.POSSIBLE_DELAY)(
            direction=direction,
            delay=amount(abs(time) * 1000, "ms", 2),
            error=amount(error * 1000, "ms", 1),
            cause=cause,
            doubt="or clocks that differ" if confirmed else REGULAR,
        )
        numbers = {"delay": time, "error": error, "correlation": rho}
        yield Finding("warning" if serious else "note", "delay", name, message, numbers)


def scales(log: Log, model: Mapping[str, Array]) -> Iterator[Finding]:
    """Yield findings on channels in another unit or with the opposite sign."""
    for name, measured in log.outputs.items():
        if name not in model:
            continue
        y, ref = moving_part(log, measured), moving_part(log, model[name])
        good = np.isfinite(y) & np.isfinite(ref)
        size = float(np.linalg.norm(y[good])) * float(np.linalg.norm(ref[good]))
        if size == 0.0:
            continue
        both = float(y[good] @ ref[good])
        rho, slope = both / size, both / float(ref[good] @ ref[good])
        numbers = {"slope": slope, "correlation": rho}
        if rho < -LIKE:
            yield Finding("warning", "sign", name, messages.WRONG_SIGN(correlation=plain(rho, 2)), numbers)
        elif rho > LIKE and _is_converted_wrongly(log, name, slope):
            yield Finding("fault", "unit", name, messages.CONVERTED_UNIT(unit=log.written[name]), numbers)
        elif rho > LIKE and (unit := other_unit(log.units[name], slope)):
            message = messages.PROBABLE_UNIT(ratio=plain(slope), unit=unit, name=name)
            yield Finding("fault", "unit", name, message, numbers)


def _is_converted_wrongly(log: Log, name: str, slope: float) -> bool:
    """Return True if a conversion from the header's unit was wrong, because the model uses that unit itself."""
    by = factor(log.written[name], log.units[name]) if name in log.undeclared else None
    return by is not None and not 0.2 < by < 5.0 and 0.7 < slope / by < 1.4


class MeasuredDelay(NamedTuple):
    """Time delay of a measured signal relative to the model [s], with its standard error.

    Attributes:
        correlation: Correlation after removal of the delay.
        frequency: Mean frequency of the signal [rad/s].
    """

    time: float
    error: float
    correlation: float
    frequency: float


def delay(log: Log, measured: Array, model: Array) -> MeasuredDelay | None:
    """Return the delay of a measured signal relative to the model, or None for dissimilar signals.

    Slow parts are removed, so that drift has no influence. A parabola refines the peak of the cross-correlation.
    """
    fast, fast_model = moving_part(log, measured), moving_part(log, model)
    lags = min(round(LONGEST_DELAY * log.slowness / log.step), log.rows // 4)
    if lags < 2 or np.isfinite(fast).sum() < 8 * lags:
        return None
    rho = correlation_at_lags(fast_model, fast, lags)
    k = int(np.argmax(np.nan_to_num(rho, nan=-1.0)))
    if not 0 < k < rho.size - 1 or not rho[k] >= TELLING or not np.isfinite(rho[k - 1 : k + 2]).all():
        return None
    bend = rho[k - 1] - 2.0 * rho[k] + rho[k + 1]
    top = 0.5 * (rho[k - 1] - rho[k + 1]) / bend if bend < 0.0 else 0.0
    # Gauss-Newton: the error of a shift is that of the residual's part along the signal's slope.
    size, slope = float(np.nanstd(fast_model)), float(np.nanstd(np.diff(fast_model))) / log.step
    independent = max(2.0, np.isfinite(fast).sum() * log.step / (SLOW * log.slowness) * 2.0)
    error = size / slope * math.sqrt(max(0.0, 1.0 / float(rho[k]) ** 2 - 1.0) / independent)
    error = max(error, 0.02 * log.step)  # limit of the parabola's accuracy
    return MeasuredDelay((k - lags + float(top)) * log.step, error, float(rho[k]), slope / size)


def _same_when_faster(log: Log, measured: Array, model: Array, slow: MeasuredDelay) -> bool | None:
    """Return True if fast changes have the same delay as slow ones; None without fast changes.

    A wrong friction or inertia has a frequency-dependent delay.
    """
    rows = max(1, round(0.1 * SLOW * log.slowness / log.step))
    changes = (np.concatenate((np.full(rows, np.nan), y[rows:] - y[:-rows])) for y in (measured, model))
    fast = delay(log, *changes)
    if fast is None or fast.frequency < FASTER * slow.frequency:
        return None
    return abs(fast.time - slow.time) < max(0.3 * abs(slow.time), 3.0 * fast.error)
