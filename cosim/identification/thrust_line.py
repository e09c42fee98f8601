"""Test 1: thrust out of ground effect over the duty (§4.5.1, eqs 4.15-4.22, App. D.3.1)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.arrays import Array, Flags
from cosim.identification.cells import Cells, at_rail, force_of
from cosim.identification.estimates import Figure, Result, made, shifts_of
from cosim.identification.protocol import Test
from cosim.identification.recordings import Recording
from cosim.identification.response import held_lag, low_pass
from plant.bench import Bench
from plant.namespaces import arrays
from plant.powertrain import ground_effect

DEGREES = (1, 2, 3)
MARGIN = 0.02  # [%] of duty kept from where the cell leaves its range: a low pass remembers
LEAST_ROWS = 50


def analyse(
    recordings: Sequence[Recording], cells: Cells, known: Bench, test: Test, truth: Bench | None, *, draw: bool = True
) -> Result:
    """Line a + b·δ [gf, gf/%]; degrees one to three, the lowest within one standard error of the best."""
    end = highest_duty(recordings, cells, known, test)
    gram = 1000.0 / known.gravity

    def kept(r: Recording) -> Flags:
        result: Flags = r.rows(test.window) & (r.duty <= end)
        return result

    def free(r: Recording) -> Array:
        gain: Array = ground_effect(arrays(), r.height[kept(r)], known.propeller_radius, known.ground_effect_exponent)
        return gain

    delayed = [low_pass(held_lag(r.duty, r.step, known.lag), r.step, test.low_pass)[kept(r)] for r in recordings]

    def lines(using: Cells) -> Array:
        return np.array(
            [
                np.polyfit(d, gram * force_of(r, using, "z", test.rest)[kept(r)] / free(r), 1)[::-1]
                for r, d in zip(recordings, delayed, strict=True)
            ]
        )

    # the thesis: every sample alike against the duty as commanded, its cell as calibrated
    duty = np.concatenate([r.duty[kept(r)] for r in recordings])
    raw = np.concatenate([gram * force_of(r, cells, "z", None)[kept(r)] for r in recordings])
    slope, offset = np.polyfit(duty, raw, 1)
    names = [
        ("thrust_offset", "gf", float(offset), truth.thrust_offset if truth else np.nan),
        ("thrust_slope", "gf/%", float(slope), truth.thrust_slope if truth else np.nan),
    ]
    each = lines(cells)
    result = Result("thrust_line", made(names, each, shifts_of(lines, cells, "z", each), "Test 1, line by repetition"))
    thrust = [gram * force_of(r, cells, "z", test.rest)[kept(r)] / free(r) for r in recordings]
    degree, errors = _degree(delayed, thrust)
    r2 = float(np.corrcoef(duty, raw)[0, 1] ** 2)
    result.more = {"degree": degree, "rmse_left_out_gf": errors, "r2": r2, "highest_duty": end}
    result.notes.append(f"r² = {r2:.4f} (eq 4.22); lowest degree within one standard error of the best: {degree}")
    top = max(float(r.duty[r.rows(test.window)].max()) for r in recordings)
    if end < top - 1e-9:
        result.notes.append(
            f"The vertical cell leaves its range above {end + MARGIN:.2f} %; samples below {end:.2f} % are used, not "
            f"up to {top:.2f} %: a cell of a larger range would show the rest."
        )
    if draw:
        result.figures = _figures(result, duty, raw, known, each, shifts_of(lines, cells, "z", each))
    return result


def highest_duty(recordings: Sequence[Recording], cells: Cells, known: Bench, test: Test) -> float:
    """The duty up to which no repetition is at the converter's end or beyond the calibration.

    Chosen by what is commanded, alike for all: leaving out readings by their value would bend the line.
    """
    end, cell = np.inf, cells["z"]
    for r in recordings:
        rows = r.rows(test.window)
        v = r.volts["z"][rows]
        beyond = at_rail(known, v) | (v < cell.volts[0]) | (v > cell.volts[-1] + 0.1 * np.ptp(cell.volts))
        if beyond.any():
            end = min(end, float(r.duty[rows][beyond].min()) - MARGIN)
    return min(end, max(float(r.duty[r.rows(test.window)].max()) for r in recordings))


def _degree(duty: Sequence[Array], thrust: Sequence[Array]) -> tuple[int, dict[int, float]]:
    """The lowest degree whose error on repetitions left out is within one standard error of the least."""
    means, spreads = {}, {}
    for degree in DEGREES:
        x = [np.vander(d - 6.0, degree + 1) for d in duty]
        gram = [a.T @ a for a in x]
        side = [a.T @ y for a, y in zip(x, thrust, strict=True)]
        rmse = []
        for k, (a, y) in enumerate(zip(x, thrust, strict=True)):
            theta = np.linalg.solve(sum(gram) - gram[k], sum(side) - side[k])
            rmse.append(float(np.sqrt(np.mean((a @ theta - y) ** 2))))
        means[degree], spreads[degree] = float(np.mean(rmse)), float(np.std(rmse, ddof=1) / np.sqrt(len(rmse)))
    best = min(means, key=lambda d: means[d])
    return next(d for d in DEGREES if means[d] <= means[best] + spreads[best]), means


def _figures(result: Result, duty: Array, raw: Array, known: Bench, each: Array, shifts: Array) -> list[Figure]:
    from scipy import stats

    grid = np.linspace(duty.min(), duty.max(), 60)
    basis = np.stack((np.ones_like(grid), grid))
    a, b = (e.value for e in result.estimates)
    covariance = np.cov(each.T) / each.shape[0] + shifts.T @ shifts
    half = stats.t.ppf(0.975, each.shape[0] - 1) * np.sqrt(np.einsum("ik,ij,jk->k", basis, covariance, basis))
    line, some = a + b * grid, slice(None, None, max(1, duty.size // 1500))
    thesis = result.estimates[0].thesis + result.estimates[1].thesis * grid
    printed = -2076.0 + 359.9 * grid
    bins = np.linspace(duty.min(), duty.max(), 9)
    place = np.clip(np.digitize(duty, bins) - 1, 0, 7)
    spread = np.array([1.96 * np.std((raw - a - b * duty)[place == k], ddof=1) for k in range(8)])
    middle = 0.5 * (bins[1:] + bins[:-1])
    return [
        Figure("Thrust over duty: data and lines", "duty [%]", "gf", [
            ("readings", duty[some], raw[some], "dots"), ("unbiased", grid, line, "true"),
            ("thesis' estimator", grid, thesis, "s1"),
        ], counterpart="Fig 4.10"),
        Figure("Thrust line with 95 % band", "duty [%]", "gf", [
            ("unbiased", grid, line, "true"), ("printed, eq 4.20", grid, printed, "reference"),
        ], band=("95 % of the line", grid, line - half, line + half),
            bars=[(middle, a + b * middle - spread, a + b * middle + spread)], counterpart="Fig 4.11"),
    ]  # fmt: skip
