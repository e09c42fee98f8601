"""Test 4: lag of the tilt behind a step (§4.5.4, App. D.3.4), and of the thrust behind a step of the duty."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.base.arrays import Array, Flags
from plant.bench import Bench
from plant.identification.cells import Cells, force_of
from plant.identification.command_response import LAGS, held_lag, low_pass, tilt_response
from plant.identification.commanded import BEFORE
from plant.identification.estimates import Figure, Result, least, made, shifts_of
from plant.identification.protocol import StepTest
from plant.identification.recordings import Recording

SETTLED = (0.68, 0.88)  # [s] after the step, over which App. D.3.4 takes the end value
SMOOTH = np.exp(-0.5 * (np.arange(-1, 2) / 10.0) ** 2) / np.exp(-0.5 * (np.arange(-1, 2) / 10.0) ** 2).sum()


def analyse(
    recordings: Sequence[Recording],
    cells: Cells,
    known: Bench,
    test: StepTest,
    truth: Bench | None,
    *,
    draw: bool = True,
    thrust: bool = False,
) -> Result:
    """τ by a fit of F_x(t), behind the servo that is known; beside it by 63 %, by rise time, by slope (§4.3.4)."""
    channel, name, title = ("z", "lag_of_thrust", "thrust") if thrust else ("x", "lag", "horizontal force")
    # every repetition plays the same commands; measured ones are told from their own
    rows = [r.rows((test.at - BEFORE, test.window[1])) for r in recordings]
    shapes: dict[bytes, Array] = {}

    def shape(r: Recording, chosen: Flags) -> Array:
        command = r.duty if thrust else r.servo_duty
        key = command.tobytes() + chosen.tobytes()
        if key not in shapes:
            if thrust:
                effective = np.maximum(r.duty, -known.thrust_offset / known.thrust_slope)
                table = np.stack([held_lag(effective, r.step, tau) for tau in LAGS], axis=1)
            else:
                table = np.sin(tilt_response(known, r.time, r.servo_duty, LAGS))
            table = low_pass(table, r.step, test.low_pass)[chosen]
            table = table - table.mean(axis=0)
            shapes[key] = table / np.sqrt((table**2).sum(axis=0))
        return shapes[key]

    def lags(using: Cells) -> Array:
        cost = []
        for r, chosen in zip(recordings, rows, strict=True):
            y = force_of(r, using, channel, test.rest)[chosen]
            y = y - y.mean()
            cost.append(y @ y - (shape(r, chosen).T @ y) ** 2)
        return least(LAGS, np.array(cost))[:, None]

    each = lags(cells)
    hand = np.array([by_hand(r, force_of(r, cells, channel, None), test) for r in recordings])
    true = truth.lag if truth else np.nan
    origin = f"Test 4, fit of the {title} after a step"
    shifts = shifts_of(lags, cells, channel, each)
    ways = ("63 %", "rise time", "slope")
    result = Result(
        "thrust_step" if thrust else "step",
        made([(name, "s", _mean(hand[:, 0]), true)], each, shifts, origin),
    )
    result.more = {
        w: {
            "mean": _mean(hand[:, k]),
            "half_width_of_one": 1.96 * _deviation(hand[:, k]),
        }
        for k, w in enumerate(ways)
    }
    result.more["single_fits"] = {"mean": float(each.mean()), "half_width_of_one": float(1.96 * each.std(ddof=1))}
    result.notes.append(
        "As the thesis reads it: "
        + ", ".join(
            f"{1000 * result.more[w]['mean']:.1f} ± {1000 * result.more[w]['half_width_of_one']:.1f} ms by {w}"
            for w in ways
        )
        + f"; single fits {1000 * each.mean():.1f} ± {1960 * each.std(ddof=1):.1f} ms (± is 1.96 σ of one test)."
    )
    step = max(r.step for r in recordings)
    if step > result.estimates[0].value:
        result.warnings.append(
            f"rows are {step:.3g} s apart, more than the lag of {result.estimates[0].value:.3g} s: nothing of its "
            "shape is in them, and the number rests on the equation of first order; record faster"
        )
    if not thrust and truth:
        result.notes.append("63 % of sin α after 25° comes at 0.961 τ, for the sine bends before the angle settles.")
    if draw:
        result.figures = _figures(result, recordings, cells, known, test, thrust=thrust)
    return result


def _mean(values: Array) -> float:
    """Return the mean of the finite values, NaN where there is none."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else float("nan")


def _deviation(values: Array) -> float:
    """Return the standard deviation of the finite values, NaN of fewer than two."""
    finite = values[np.isfinite(values)]
    return float(finite.std(ddof=1)) if finite.size > 1 else float("nan")


def by_hand(r: Recording, force: Array, test: StepTest) -> tuple[float, float, float]:
    """τ of one test by 63 %, by rise time over 2.2 and by the first slope, smoothed over three rows (App. D.3.4)."""
    time = r.time - test.at
    start = float(force[(time > -BEFORE) & (time < 0)].mean())
    smooth = np.convolve(force - start, SMOOTH, mode="same")
    rows = (time >= 0) & (time <= test.window[1] - test.at)
    t, y = time[rows], smooth[rows]
    end = float(y[(t >= SETTLED[0]) & (t <= SETTLED[1])].mean()) if (t[-1] >= SETTLED[1]) else float(y[-10:].mean())
    y = y / end

    def reached(level: float) -> float:
        above = np.flatnonzero(y >= level)
        if not above.size or above[0] == 0:
            return float("nan")
        k = int(above[0])
        return float(t[k] - (t[k] - t[k - 1]) * (y[k] - level) / (y[k] - y[k - 1]))

    slope = float(np.polyfit(t[:3], y[:3], 1)[0])
    return reached(0.63), (reached(0.9) - reached(0.1)) / 2.2, 1.0 / slope if slope > 0 else float("nan")


def _figures(
    result: Result,
    recordings: Sequence[Recording],
    cells: Cells,
    known: Bench,
    test: StepTest,
    *,
    thrust: bool,
) -> list[Figure]:
    gram, lines, channel = 1000.0 / known.gravity, [], "z" if thrust else "x"
    x, y = [], []
    for r in recordings:
        rows = r.rows((test.at - 0.1, test.at + 0.9))
        f = gram * force_of(r, cells, channel, test.rest)
        x += [*(r.time[rows] - test.at), np.nan]
        y += [*f[rows], np.nan]
    lines.append((f"{len(recordings)} tests", np.array(x), np.array(y), "s0"))
    r, tau = recordings[0], result.estimates[0].value
    rows = r.rows((test.at - 0.1, test.at + 0.9))
    if thrust:
        shape = held_lag(np.maximum(r.duty, -known.thrust_offset / known.thrust_slope), r.step, tau)
    else:
        shape = np.sin(tilt_response(known, r.time, r.servo_duty, np.array([tau]))[:, 0])
    shape = low_pass(shape, r.step, test.low_pass)[rows]
    mean = np.mean(
        [gram * force_of(q, cells, channel, test.rest)[rows] for q in recordings if q.time.size == r.time.size], axis=0
    )
    slope, offset = np.polyfit(shape, mean, 1)
    lines.append((f"fit, τ = {1000 * tau:.1f} ms", r.time[rows] - test.at, offset + slope * shape, "true"))
    what = "thrust after a step of the duty" if thrust else "horizontal force after a step of the tilt"
    return [
        Figure(
            f"Answer of the {what}",
            "time after the step [s]",
            "gf",
            lines,
            counterpart="no counterpart" if thrust else "Fig 4.16",
        )
    ]
