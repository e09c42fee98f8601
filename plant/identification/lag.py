"""Test 4: lag of the tilt after a step (§4.5.4, App. D.3.4), and of the thrust after a step of the duty."""

from __future__ import annotations

import numpy as np

from cosim.base.arrays import Array, Flags
from plant.identification import messages
from plant.identification.cells import Cells
from plant.identification.command_response import LAGS, held_lag, low_pass, tilt_response
from plant.identification.estimates import (
    Figure,
    Measurement,
    Result,
    least,
    make_estimates,
    shifts_of,
)
from plant.identification.protocol import StepTest
from plant.identification.recordings import Recording

BEFORE = 0.3  # [s] before a step in a fit
SETTLED = (0.68, 0.88)  # [s] after the step, window of the end value in App. D.3.4
SMOOTH = np.exp(-0.5 * (np.arange(-1, 2) / 10.0) ** 2) / np.exp(-0.5 * (np.arange(-1, 2) / 10.0) ** 2).sum()


def analyse(m: Measurement, *, draw: bool = True, thrust: bool = False) -> Result:
    """Return τ from a fit of F_x(t), of the thrust if `thrust`, and by 63 %, rise time and slope (§4.3.4)."""
    channel, name, title = ("z", "lag_of_thrust", "thrust") if thrust else ("x", "lag", "horizontal force")
    # simulated repetitions share commands; measured ones have their own
    rows = [r.rows((m.test.at - BEFORE, m.test.window[1])) for r in m.recordings]
    tables: dict[bytes, Array] = {}
    shapes: dict[bytes, Array] = {}

    def key_of(r: Recording) -> bytes:
        return r.time.tobytes() + (r.duty if thrust else r.servo_duty).tobytes()

    def response(r: Recording) -> Array:
        if (key := key_of(r)) not in tables:
            tables[key] = _response(m, r, LAGS, thrust=thrust)
        return tables[key]

    def shape(r: Recording, chosen: Flags) -> Array:
        if (key := key_of(r) + chosen.tobytes()) not in shapes:
            table = response(r)[chosen]
            table = table - table.mean(axis=0)
            shapes[key] = table / np.sqrt((table**2).sum(axis=0))
        return shapes[key]

    def lags(using: Cells) -> Array:
        cost = []
        for r, chosen in zip(m.recordings, rows, strict=True):
            y = m.force(r, channel, using)[chosen]
            y = y - y.mean()
            cost.append(y @ y - (shape(r, chosen).T @ y) ** 2)
        return least(LAGS, np.array(cost))[:, None]

    each = lags(m.cells)
    hand = np.array([by_hand(r, m.printed_force(r, channel), m.test) for r in m.recordings])
    names = [(name, "s", _mean_and_half(hand[:, 0])[0], m.true("lag"))]
    shifts, origin = shifts_of(lags, m.cells, channel, each), f"Test 4, fit of the {title} after a step"
    result = Result("thrust_step" if thrust else "step", make_estimates(names, each, shifts, origin))
    ways = []
    for k, way in enumerate(("63 %", "rise time", "slope")):
        mean, half = _mean_and_half(hand[:, k])
        result.details[way] = {"mean": mean, "half_width_of_one": half}
        ways.append(f"{1000 * mean:.1f} ± {1000 * half:.1f} ms by {way}")
    mean, half = float(each.mean()), float(1.96 * each.std(ddof=1))
    result.details["single_fits"] = {"mean": mean, "half_width_of_one": half}
    result.notes.append(messages.THESIS_STEPS(ways=", ".join(ways), mean=1000 * mean, half=1000 * half))
    tau = result.estimates[0].value
    if not thrust and m.truth:
        result.notes.append(messages.SINE_BENDS())
    if draw:
        result.figures = [_figure(m, tau, thrust=thrust)]
    return result


def _response(m: Measurement, r: Recording, lags: Array, *, thrust: bool) -> Array:
    """Return the sine of the tilt, or with `thrust` the duty, after each lag and the low pass, shape (rows, lags)."""
    if thrust:
        effective = np.maximum(r.duty, -m.bench.thrust_offset / m.bench.thrust_slope)
        table = np.stack([held_lag(effective, r.step, tau) for tau in lags], axis=1)
    else:
        table = np.sin(tilt_response(m.bench, r.time, r.servo_duty, lags))
    return low_pass(table, r.step, m.test.low_pass)


def _mean_and_half(values: Array) -> tuple[float, float]:
    """Return mean and 1.96 σ of the finite values."""
    finite = values[np.isfinite(values)]
    mean = float(finite.mean()) if finite.size else float("nan")
    return mean, 1.96 * float(finite.std(ddof=1)) if finite.size > 1 else float("nan")


def by_hand(r: Recording, force: Array, test: StepTest) -> tuple[float, float, float]:
    """Return τ by 63 %, by rise time over 2.2, and by the initial slope (App. D.3.4)."""
    time = r.time - test.at
    start = float(force[(time > -BEFORE) & (time < 0)].mean())
    smooth = np.convolve(force - start, SMOOTH, mode="same")
    rows = (time >= 0) & (time <= test.window[1] - test.at)
    t, y = time[rows], smooth[rows]
    end = float(y[(t >= SETTLED[0]) & (t <= SETTLED[1])].mean()) if (t[-1] >= SETTLED[1]) else float(y[-10:].mean())
    y = y / end

    def time_of(level: float) -> float:
        above = np.flatnonzero(y >= level)
        if not above.size or above[0] == 0:
            return float("nan")
        k = int(above[0])
        return float(t[k] - (t[k] - t[k - 1]) * (y[k] - level) / (y[k] - y[k - 1]))

    slope = float(np.polyfit(t[:3], y[:3], 1)[0])
    return time_of(0.63), (time_of(0.9) - time_of(0.1)) / 2.2, 1.0 / slope if slope > 0 else float("nan")


def _figure(m: Measurement, tau: float, *, thrust: bool) -> Figure:
    channel, window = "z" if thrust else "x", (m.test.at - 0.1, m.test.at + 0.9)
    x, y = [], []
    for r in m.recordings:
        rows = r.rows(window)
        x += [*(r.time[rows] - m.test.at), np.nan]
        y += [*m.gram * m.force(r, channel)[rows], np.nan]
    r = m.recordings[0]
    rows = r.rows(window)
    shape = _response(m, r, np.array([tau]), thrust=thrust)[rows, 0]
    forces = [m.gram * m.force(q, channel)[rows] for q in m.recordings if q.time.size == r.time.size]
    slope, offset = np.polyfit(shape, np.mean(forces, axis=0), 1)
    tests = (f"{len(m.recordings)} tests", np.array(x), np.array(y), "s0")
    fit = (f"fit, τ = {1000 * tau:.1f} ms", r.time[rows] - m.test.at, offset + slope * shape, "true")
    title = (
        f"{'Thrust after a step of the duty' if thrust else 'Horizontal force after a step of the tilt'}: tests and fit"
    )
    counterpart = "" if thrust else "Fig 4.16"
    return Figure(title, "time after the step [s]", "gf", [tests, fit], counterpart=counterpart)
