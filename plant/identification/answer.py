"""Shape of a step response: first order, early, late, or of another shape."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from cosim.base.arrays import Array, Flags
from plant.identification import messages
from plant.identification.cells import Cells
from plant.identification.command_response import LAGS
from plant.identification.commanded import BEFORE
from plant.identification.estimates import Measurement, Result, shifts_of
from plant.identification.misfit import SHARE, Misfit, is_quieter, misfit, residuals
from plant.identification.recordings import Recording

PARAMETERS = 3  # parameters of each repetition: offset, size and lag
DELAYS = np.linspace(-BEFORE, BEFORE, 61)  # [s] delays to try
Response = Callable[[Recording], Array]  # force of a run's commands, one column for each of LAGS


def judge(m: Measurement, result: Result, channel: str, response: Response, rows: Sequence[Flags]) -> None:
    """Compare a step response with the assumed first-order shape.

    A force earlier than its command is added to `result` as a fault, a different shape as a warning.

    Args:
        channel: Cell whose force is compared.
        response: Function from a recording to the assumed response, one column for each of LAGS.
        rows: Compared rows of each recording.
    """
    # rows of each run nearest to the slowest clock
    slowest = max(m.recordings, key=lambda r: r.step)
    clock = slowest.time[rows[m.recordings.index(slowest)]]
    places = [np.clip(np.searchsorted(r.time, clock - 0.5 * r.step), 0, r.time.size - 1) for r in m.recordings]
    tau, end = result.estimates[0].value, (0.5 * (m.test.at + m.test.window[1]), m.test.window[1])
    volts = [[r.volts[channel][r.rows(window)] for r in m.recordings] for window in (m.test.rest, end)]
    if is_quieter(*volts):
        result.warnings.append(messages.NOISE_FALLS(cell=channel))

    def shape_residuals(using: Cells) -> Array:
        """Return the residuals of the shape, shape (repetitions, rows)."""
        values = []
        for r, place in zip(m.recordings, places, strict=True):
            basis = np.column_stack((np.ones(place.size), *_at_lag(response(r)[place], tau)))
            values.append(residuals(m.force(r, channel, using)[place], basis))
        return np.array(values)

    each = shape_residuals(m.cells)
    shape = misfit(each, shifts_of(shape_residuals, m.cells, channel, each), PARAMETERS)
    if shape is None or not shape.is_significant:
        return
    force = np.mean([m.force(r, channel)[place] for r, place in zip(m.recordings, places, strict=True)], axis=0)
    first = m.recordings[0]

    def later(delay: float) -> Array:
        """Return the delayed response at the times of `clock`, one column for each of LAGS."""
        return np.array([np.interp(clock - delay, first.time, column) for column in response(first).T]).T

    _explain(result, shape, force, clock, m.test.at, later)


def _at_lag(table: Array, lag: float) -> tuple[Array, Array]:
    """Return the response at a lag, interpolated between the columns (one per LAGS), and its change to the next lag."""
    k = int(np.clip(np.searchsorted(LAGS, lag) - 1, 0, LAGS.size - 2))
    share = float(np.log(lag / LAGS[k]) / np.log(LAGS[k + 1] / LAGS[k]))
    return table[:, k] + share * (table[:, k + 1] - table[:, k]), table[:, k + 1] - table[:, k]


def _explain(
    result: Result, shape: Misfit, force: Array, clock: Array, at: float, later: Callable[[float], Array]
) -> None:
    """Add the explanation of a misfit: a delay, a sine, or its size.

    Args:
        force: Mean force at the times `clock`; the command changes at `at`.
        later: Function from a delay to the delayed response, one column for each of LAGS.
    """
    # the same response, shifted: the best of all lags and delays
    fits = [(delay, *_fit_column(force, later(delay))) for delay in DELAYS.tolist()]
    delay, fitted, k = min(fits, key=lambda fit: float((force - fit[1]) @ (force - fit[1])))
    size = float(np.ptp(_fit_column(force, later(0.0))[0]))
    explained = shape.size() - shape.size(force - fitted)
    miss = 100.0 * float(np.abs(shape.mean).max()) / max(size, 1e-300)
    is_delay = explained > SHARE * shape.size() and shape.exceeds_chance(explained, 1.0)
    is_early = _moves_before(shape, clock, at)
    if is_delay and delay < 0.0 and is_early:
        result.faults.append(messages.EARLY_STEP(delay=-delay))
    elif is_delay and delay > 0.0:
        result.warnings.append(messages.LATE_STEP(miss=miss, delay=delay, lag=LAGS[k]))
    elif is_early and (frequency := _frequency(shape.mean, step := float(np.median(np.diff(clock))))):
        result.warnings.append(messages.HUM(miss=miss, frequency=frequency, rate=1.0 / step))
    else:
        result.warnings.append(messages.NOT_FIRST_ORDER(miss=miss))


def _moves_before(shape: Misfit, clock: Array, at: float) -> bool:
    """Return whether the mean residual precedes the command."""
    before = clock < at - 1e-9
    if before.sum() < 2:
        return False
    values = np.where(before, shape.mean - shape.mean[before].mean(), 0.0)
    return shape.exceeds_chance(shape.size(values), float(before.sum()) - 1.0)


def _fit_column(force: Array, table: Array) -> tuple[Array, int]:
    """Return the fit of a force by an offset and the best scaled column of a table, and the column's index."""
    shape = table - table.mean(axis=0)
    norm = np.sqrt((shape**2).sum(axis=0))
    along = np.divide(shape.T @ force, norm, out=np.zeros(norm.size), where=norm > 0.0)
    k = int(np.argmax(np.abs(along)))
    return force.mean() + along[k] / (norm[k] or 1.0) * shape[:, k], k


def _frequency(values: Array, step: float) -> float:
    """Return a sinusoidal residual's frequency [Hz], else 0."""
    power = np.abs(np.fft.rfft(values - values.mean())) ** 2
    k = int(np.argmax(power))
    is_sine = power[max(0, k - 1) : k + 2].sum() > SHARE * power.sum() and k >= 2
    return k / values.size / step if is_sine else 0.0
