"""Comparison of a log with predictions of the model, to find wrong clocks, units, signs and columns."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np

from cosim.core.arrays import Array, NamedArrays, NamedValues, correlation_at_lags
from cosim.core.text import amount, plain
from cosim.core.units import alternatives, factor
from cosim.logs.log import Finding, Log, noise_level

OTHER_SIZE = 5.0  # ratio to the model from which a size is another one
SAME_SIZE = (0.7, 1.4)  # ratio to the model within which a size is the same
MIN_SHARE_OF_BOUND = 0.02  # least size relative to its bound in the right unit
SLOW_CHANGE_S = 1.0  # [s] slower changes also come from drift and the unknown start
LONGEST_DELAY = 0.5  # [s]
LIKE = 0.85  # correlation of a signal with its model output that is not by chance
TELLING = 0.6  # least correlation with the model for a delay estimate
MAX_SLOPE_ERROR = 0.1  # standard error of a slope relative to the slope
BLOCKS, MIN_BLOCK = 20, 10  # blocks of rows for the standard error, and rows of a block
MIN_SIGNAL = 3.0  # multiple of its noise above which the size of a signal is meaningful
REGULAR = "or, because the motion is nearly periodic, a wrong friction or inertia"
INDEPENDENT_FREQUENCY_RATIO = 1.15  # ratio of mean frequencies from which fast changes are independent evidence

DIRECTIONS = {  # likely causes of a positive delay, and of a negative delay
    True: ("trails", "a delay or a slower actuator"),
    False: ("leads", "a faster actuator or a command logged late"),
}


def input_unit_findings(log: Log, starts: NamedValues, bounds: Mapping[str, tuple[float, float]]) -> Iterator[Finding]:
    """Yield findings on inputs whose size fits the model only in another unit.

    Args:
        starts: Start value of each input in the model.
        bounds: Limits declared by the model; a size beyond them is a fault.
    """
    for name, values in log.inputs.items():
        size, start = float(np.abs(values).max()), abs(starts.get(name, 0.0))
        bound = max(map(abs, bounds.get(name, (math.inf,))))
        unit = log.units[name]
        if size > OTHER_SIZE * bound and unit != "rad":  # angles are checked against their bounds elsewhere
            # in the right unit, the input would lie within its bound
            question = other_unit(name, unit, size / bound, (MIN_SHARE_OF_BOUND, 1.0))
            text = f"reaches {amount(size, unit)}, far beyond the limit {amount(bound, unit)} of the model"
            text += f"; {question}" if question else ": it may be scaled, or in another unit"
            yield Finding("fault", "unit", name, text)
        elif start and (question := other_unit(name, unit, size / start)):
            text = (
                f"reaches {amount(size, unit)}, but the start value in the model is {amount(start, unit)}; {question}"
            )
            yield Finding("warning", "unit", name, text)


def other_unit(name: str, unit: str, ratio: float, around: tuple[float, float] = SAME_SIZE) -> str:
    """Return advice on the unit of a column if another unit fits the ratio of sizes (log to model), else ""."""
    if not unit or 1.0 / OTHER_SIZE < ratio < OTHER_SIZE:
        return ""
    sizes = {other: factor(other, unit) for other in (*alternatives(unit), "rpm")}
    other = next((u for u, f in sizes.items() if f and around[0] < ratio * f < around[1]), "")
    return other and f'if its unit is {other}, rename the column to "{name} [{other}]"'


def output_findings(log: Log, model: NamedArrays) -> list[Finding]:
    """Return findings on outputs that, compared with the model, are late, in another unit, reversed or swapped."""
    return [*scales(log, model), *swaps(log, model), *delays(log, model)]


def delays(log: Log, model: NamedArrays) -> Iterator[Finding]:
    """Yield findings on channels with a delay of at least half a row; delays of slow channels are too uncertain."""
    estimates = {n: d for n, y in log.outputs.items() if n in model and (d := delay(log, y, model[n])) is not None}
    fastest = max((d.frequency for d in estimates.values()), default=0.0)
    for name, (time, error, frequency) in estimates.items():
        if frequency < 0.6 * fastest or abs(time) < max(4.0 * error, 0.4 * log.step):
            continue
        # A wrong friction or inertia causes a delay that depends on the frequency: is that of fast changes the same?
        rows = max(1, round(0.1 * SLOW_CHANGE_S * log.slowness / log.step))
        changes = (np.append(np.full(rows, np.nan), y[rows:] - y[:-rows]) for y in (log.outputs[name], model[name]))
        fast = delay(log, *changes)
        confirmed = fast is not None and fast.frequency >= INDEPENDENT_FREQUENCY_RATIO * frequency
        if fast is not None and confirmed and not abs(fast.time - time) < max(0.3 * abs(time), 3.0 * fast.error):
            continue
        serious, (direction, cause) = confirmed and abs(time) > log.step, DIRECTIONS[time > 0]
        doubt = "or different clocks" if confirmed else REGULAR
        size = f"{amount(abs(time) * 1000, 'ms', 2)} ± {amount(error * 1000, 'ms', 1)}"
        message = f"{direction} the model by {size}: {cause}, {doubt}"
        yield Finding("warning" if serious else "note", "delay", name, message, {"delay": time, "error": error})


def scales(log: Log, model: NamedArrays) -> Iterator[Finding]:
    """Yield findings on channels in another unit or with the opposite sign."""
    for name, measured in log.outputs.items():
        if name not in model or (fit := fit_slope(log, measured, model[name])) is None:
            continue
        unit, written, numbers = log.units[name], log.written.get(name, ""), {"slope": fit.slope}
        times = f"{plain(fit.slope)} ± {plain(fit.error, 1)} times as much"
        is_alike = fit.correlation > LIKE
        if fit.correlation < -LIKE or (fit.is_certain and SAME_SIZE[0] < -fit.slope < SAME_SIZE[1]):
            message = (
                f"moves opposite to the model ({times}, correlation {plain(fit.correlation, 2)}): this column or an "
                "input has the wrong sign"
            )
            yield Finding("warning", "sign", name, message, numbers)
        elif is_alike or fit.is_certain:
            by = factor(written, unit)
            beyond = by is not None and not 1.0 / OTHER_SIZE < by < OTHER_SIZE
            if by is not None and beyond and SAME_SIZE[0] < fit.slope / by < SAME_SIZE[1]:
                message = (
                    f"was converted from {written} to {unit}, but agrees with the model without this conversion: "
                    "remove "
                    f'"[{written}]" from the header'
                )
            elif question := other_unit(name, unit, fit.slope):
                message = f"follows the model, but {times}; {question}"
            else:
                continue
            yield Finding("fault" if is_alike else "warning", "unit", name, message, numbers)
        else:  # even without correlation, a signal may be larger than its prediction by a factor between units
            size, own = (float(np.nanstd(fast_part(log, values))) for values in (measured, model[name]))
            ratio = size / own if own > 0.0 and size > MIN_SIGNAL * noise_level(measured) else 0.0
            if ratio > OTHER_SIZE and (question := other_unit(name, unit, ratio)):
                yield Finding(
                    "warning", "unit", name, f"moves {plain(ratio, 2)} times as much as the model; {question}"
                )


def swaps(log: Log, model: NamedArrays) -> Iterator[Finding]:
    """Yield findings on pairs of outputs that fit each other's prediction better than their own, at any delay."""
    names = [name for name in log.outputs if name in model]
    for one, other in combinations(names, 2):
        least = 1.0  # correlation of either with the prediction of the other, of the same size as in the other's unit
        for a, b in ((one, other), (other, one)):
            fit = fit_slope(log, log.outputs[a], model[b])
            own, others = (factor(log.written.get(n, ""), log.units[n]) or 1.0 for n in (a, b))
            fits = fit is not None and fit.is_certain and SAME_SIZE[0] < fit.slope * others / own < SAME_SIZE[1]
            least = min(least, abs(fit.correlation) if fit is not None and fits else 0.0)
        if least < 0.5 * TELLING:
            continue
        largest = 0.0  # the largest correlation of either with its own prediction, at any delay
        for name in (one, other):
            parts = fast_part(log, model[name]), fast_part(log, log.outputs[name])
            largest = float(np.nanmax(np.abs(correlation_at_lags(*parts, _longest_lag(log))), initial=largest))
        if largest < least:
            text = (
                f"follows the model's {other} (correlation {plain(least, 2)}), and {other} follows {one}: the "
                "columns may be swapped"
            )
            yield Finding("warning", "swapped", one, text)


def _longest_lag(log: Log) -> int:
    """Return the longest delay that is tried [rows]."""
    return max(0, min(round(LONGEST_DELAY * log.slowness / log.step), log.rows // 4))


class SlopeFit(NamedTuple):
    """Least-squares slope of a measured signal over its prediction, after removal of slow parts.

    Attributes:
        error: Standard error from blocks of rows, valid for correlated residuals; infinite without enough rows.
    """

    slope: float
    error: float
    correlation: float

    @property
    def is_certain(self) -> bool:
        """Return True if the standard error is small relative to the slope."""
        return self.error < MAX_SLOPE_ERROR * abs(self.slope)


def fit_slope(log: Log, measured: Array, model: Array) -> SlopeFit | None:
    """Return the slope of a measured signal over its prediction; None if one of them is constant."""
    y, x = fast_part(log, measured), fast_part(log, model)
    good = np.isfinite(y) & np.isfinite(x)
    y, x = y[good], x[good]
    size = float(np.linalg.norm(y)) * float(np.linalg.norm(x))
    if not size > 0.0:
        return None
    both, square = float(y @ x), float(x @ x)
    slope, error = both / square, math.inf
    if x.size >= BLOCKS * MIN_BLOCK:
        error = math.hypot(*(float(part.sum()) for part in np.array_split(x * (y - slope * x), BLOCKS))) / square
    return SlopeFit(slope, error, both / size)


class MeasuredDelay(NamedTuple):
    """Time delay of a measured signal relative to the model [s], with its standard error.

    Attributes:
        frequency: Mean frequency of the signal [rad/s].
    """

    time: float
    error: float
    frequency: float


def delay(log: Log, measured: Array, model: Array) -> MeasuredDelay | None:
    """Return the delay of a measured signal relative to the model, or None if the signals are not similar.

    Slow parts are removed, so that drift has no influence. A parabola refines the peak of the cross-correlation.
    """
    fast, fast_model = fast_part(log, measured), fast_part(log, model)
    lags = _longest_lag(log)
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
    independent = max(2.0, np.isfinite(fast).sum() * log.step / (SLOW_CHANGE_S * log.slowness) * 2.0)
    error = size / slope * math.sqrt(max(0.0, 1.0 / float(rho[k]) ** 2 - 1.0) / independent)
    error = max(error, 0.02 * log.step)  # limit of the parabola's accuracy
    return MeasuredDelay((k - lags + float(top)) * log.step, error, slope / size)


def fast_part(log: Log, values: Array) -> Array:
    """Return the deviation of a signal from its moving mean over SLOW_CHANGE_S·slowness seconds; NaN at both ends."""
    from scipy.ndimage import uniform_filter1d

    half, finite = max(1, round(0.5 * SLOW_CHANGE_S * log.slowness / log.step)), np.isfinite(values)
    parts = np.where(finite, values, 0.0), finite.astype(np.float64)
    mean, share = (uniform_filter1d(part, 2 * half + 1, mode="constant") for part in parts)
    with np.errstate(invalid="ignore", divide="ignore"):
        fast = np.asarray(values - mean / share)
    fast[:half] = fast[-half:] = np.nan
    return fast
