"""Shape of a step response: first order, early, late, or of another shape."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from cosim.base.arrays import Array, Flags
from plant.identification.cells import Cells
from plant.identification.command_response import LAGS
from plant.identification.commanded import BEFORE
from plant.identification.estimates import Measured, Result, shifts_of
from plant.identification.misfit import SHARE, Misfit, is_quieter, misfit, residuals
from plant.identification.recordings import Recording

PARAMETERS = 3  # parameters of each repetition: offset, size and lag
DELAYS = np.linspace(-BEFORE, BEFORE, 61)  # [s] delays to try
Response = Callable[[Recording], Array]  # force of a run's commands, one column for each of LAGS


def judge(m: Measured, result: Result, channel: str, response: Response, rows: Sequence[Flags]) -> None:
    """Add a fault for a force before its command, and a warning for another shape."""
    # rows of each run nearest to the slowest clock
    slowest = max(m.recordings, key=lambda r: r.step)
    clock = slowest.time[rows[m.recordings.index(slowest)]]
    places = [np.clip(np.searchsorted(r.time, clock - 0.5 * r.step), 0, r.time.size - 1) for r in m.recordings]
    tables: dict[bytes, Array] = {}

    def table(r: Recording) -> Array:
        key = r.time.tobytes() + r.duty.tobytes() + r.servo_duty.tobytes()
        if key not in tables:
            tables[key] = response(r)
        return tables[key]

    tau = result.estimates[0].value
    if is_quieter(
        [r.volts[channel][r.rows(m.test.rest)] for r in m.recordings],
        [r.volts[channel][r.rows((0.5 * (m.test.at + m.test.window[1]), m.test.window[1]))] for r in m.recordings],
    ):
        result.warnings.append(
            f"volts_{channel} has less noise after the step than at rest: the cell or its amplifier is at its end; "
            "take a larger range or a smaller step"
        )

    def missed(using: Cells) -> Array:
        """Return the residuals of the shape, shape (repetitions, rows)."""
        found = []
        for r, place in zip(m.recordings, places, strict=True):
            values, slope = _at_lag(table(r)[place], tau)
            basis = np.column_stack((np.ones(place.size), values, slope))
            found.append(residuals(m.force(r, channel, using)[place], basis))
        return np.array(found)

    each = missed(m.cells)
    found = misfit(each, shifts_of(missed, m.cells, channel, each), PARAMETERS)
    if found is None or not found.significant:
        return
    force = np.mean([m.force(r, channel)[place] for r, place in zip(m.recordings, places, strict=True)], axis=0)
    first = m.recordings[0]

    def later(delay: float) -> Array:
        """Return the delayed response on the clock, one column for each of LAGS."""
        return np.array([np.interp(clock - delay, first.time, column) for column in table(first).T]).T

    _explain(result, found, force, clock, m.test.at, later)


def _at_lag(table: Array, lag: float) -> tuple[Array, Array]:
    """Return the response at a lag and its slope by the logarithm of the lag."""
    k = int(np.clip(np.searchsorted(LAGS, lag) - 1, 0, LAGS.size - 2))
    share = float(np.log(lag / LAGS[k]) / np.log(LAGS[k + 1] / LAGS[k]))
    return table[:, k] + share * (table[:, k + 1] - table[:, k]), table[:, k + 1] - table[:, k]


def _explain(
    result: Result, found: Misfit, force: Array, clock: Array, at: float, later: Callable[[float], Array]
) -> None:
    """Add the explanation of a misfit: a delay, a sine, or its size."""
    size = float(np.ptp(_fitted(force, later(0.0))[0]))
    # the same response, shifted: the best of all lags and delays
    best: tuple[float, float, float, Array] | None = None
    for delay in DELAYS:
        fitted, k = _fitted(force, later(float(delay)))
        miss = force - fitted
        if best is None or float(miss @ miss) < best[0]:
            best = float(miss @ miss), float(delay), float(LAGS[k]), miss
    assert best is not None
    _, delay, lag, miss = best
    whole = found.size()
    explained = whole - found.size(miss)
    largest = 100.0 * float(np.abs(found.mean).max()) / max(size, 1e-300)
    missed = f"the mean answer misses the curve of first order by up to {largest:.2g} % of the step"
    missed += ", more than the scatter of the repetitions"
    delayed = explained > SHARE * whole and found.is_significant(explained, 1.0)
    if delayed and delay < 0.0 and _moves_before(found, clock, at):
        result.faults.append(
            f"the force moves some {-delay:.2g} s before its command: the cells are ahead of the commands by as much; "
            "record both by one clock, or shift the columns of volts"
        )
    elif delayed and delay > 0.0:
        result.warnings.append(
            f"{missed}: the force answers some {delay:.2g} s late, as a pure delay does, and with that delay the lag "
            f"is {lag:.2g} s; look at the clocks of commands and cells"
        )
    else:
        text = f"{missed}: it is not of first order, and the lag stands for none of its own"
        sine = _sine(found.mean, clock) if _moves_before(found, clock, at) else ""
        result.warnings.append(text + (sine or "; look at the cell, its range and the motor"))


def _moves_before(found: Misfit, clock: Array, at: float) -> bool:
    """Return whether the mean residual moves before the command beyond its scatter."""
    before = clock < at - 1e-9
    if before.sum() < 2:
        return False
    values = np.where(before, found.mean - found.mean[before].mean(), 0.0)
    return found.is_significant(found.size(values), float(before.sum()) - 1.0)


def _fitted(force: Array, table: Array) -> tuple[Array, int]:
    """Return offset plus the best scaled column for a force, and the column's index."""
    shape = table - table.mean(axis=0)
    norm = np.sqrt((shape**2).sum(axis=0))
    along = np.divide(shape.T @ force, norm, out=np.zeros(norm.size), where=norm > 0.0)
    k = int(np.argmax(np.abs(along)))
    return force.mean() + along[k] / (norm[k] or 1.0) * shape[:, k], k


def _sine(values: Array, clock: Array) -> str:
    """Name the frequency of a sinusoidal residual."""
    power = np.abs(np.fft.rfft(values - values.mean())) ** 2
    k = int(np.argmax(power))
    if not power[max(0, k - 1) : k + 2].sum() > SHARE * power.sum() or k < 2:
        return ""
    step = float(np.median(np.diff(clock)))
    return (
        f"; a sine of {k / values.size / step:.2g} Hz is on it, in rows of {1.0 / step:.3g} Hz to which faster ones "
        "fold: is it hum of the mains, or an oscillation? Shield or filter the cell"
    )
