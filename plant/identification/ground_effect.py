"""Test 2: ground effect over the height (§4.5.2, eqs 4.23-4.28, App. D.3.2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from cosim.base.arrays import Array
from cosim.model.namespaces import arrays
from plant.identification import messages
from plant.identification.cells import Cells
from plant.identification.estimates import (
    Figure,
    Measurement,
    Result,
    interval,
    make_estimates,
    pseudo_values,
    shifts_of,
)
from plant.identification.protocol import HeightTest
from plant.identification.recordings import Recording
from plant.powertrain import ground_effect

CHEESEMAN_BENNETT = 2.0


def analyse(m: Measurement, *, draw: bool = True) -> Result:
    """Return the exponent k by least squares on Γ.

    The thesis uses ln((Γ−1)/Γ) (4.24), which is undefined for Γ ≤ 1.
    """
    main, *others = sets_by_duty(m.recordings, m.test)
    heights = np.array(sorted(h for h in main if h < m.test.free_height))
    free = max(main)
    count = min(len(main[h]) for h in main)
    radius = m.bench.propeller_radius

    def forces(force: Callable[[Recording], Array], chosen: dict[float, list[Recording]] = main) -> Array:
        """Return mean forces, shape (heights, repetitions), free height last."""
        least = min(len(chosen[h]) for h in (*heights, free))
        rows = [[float(force(r)[r.rows(m.test.window)].mean()) for r in chosen[h][:least]] for h in (*heights, free)]
        return np.array(rows)

    def gains(using: Cells, estimate: Callable[[Array], Array] = np.asarray) -> Array:
        """Return pseudo-values of an estimate from Γ, by default Γ itself, shape (repetitions, heights)."""
        f = forces(lambda r: m.force(r, "z", using))
        return pseudo_values(lambda rows: estimate(f[:-1, rows].mean(axis=1) / f[-1, rows].mean()), count)

    def exponents(using: Cells) -> Array:
        return gains(using, lambda gain: np.array([fit(heights, gain, radius, free)]))

    raw = forces(lambda r: m.printed_force(r, "z"))
    thesis, dropped = _thesis(heights / radius, raw[:-1] / raw[-1])
    each = exponents(m.cells)
    names = [("ground_effect_exponent", "1", thesis, m.true("ground_effect_exponent"))]
    shifts = shifts_of(exponents, m.cells, "z", each)
    result = Result("ground_effect", make_estimates(names, each, shifts, "Test 2, fit on Γ, 1/Z̄"))
    if dropped:
        result.notes.append(messages.RATIOS_WITHOUT_LOGARITHM(count=dropped, total=count * heights.size))
    model = _relative_gain(heights, radius, result.estimates[0].value, free)
    each_gain = gains(m.cells)
    result.details = {"heights_over_radius": (heights / radius).tolist(), "dropped": dropped}
    for chosen in others:
        f = forces(lambda r: m.force(r, "z"), chosen)
        run = chosen[free][0]
        duty = float(np.median(run.duty[run.rows(m.test.window)]))
        rms = float(np.sqrt(np.mean((f[:-1].mean(axis=1) / f[-1].mean() - model) ** 2)))
        result.details["validation_rmse"] = rms
        result.notes.append(messages.VALIDATION(duty=duty, rms=rms))
    if draw:
        result.figures = _figures(result, heights / radius, forces(lambda r: m.force(r, "z")), each_gain)
    return result


def fit(heights: Array, gains: Array, radius: float, free: float) -> float:
    """Return the best k for measured Γ with weights 1/Z̄ (4.27), by Gauss-Newton.

    Args:
        gains: Γ at `heights`, relative to the height `free`.
        radius: Radius of the propeller.
    """
    k, weights = CHEESEMAN_BENNETT, radius / heights
    for _ in range(12):
        here = _relative_gain(heights, radius, k, free)
        slope = (_relative_gain(heights, radius, k + 1e-6, free) - here) / 1e-6
        step = float((weights * slope * (gains - here)).sum() / (weights * slope**2).sum())
        k = float(np.clip(k + np.clip(step, -0.5, 0.5), 0.3, 6.0))
        if abs(step) < 1e-10:
            break
    return k


def _gain(heights: Array, radius: float, exponent: float) -> Array:
    gain: Array = ground_effect(arrays(), np.asarray(heights, float), radius, exponent)
    return gain


def _relative_gain(heights: Array, radius: float, exponent: float, free: float) -> Array:
    """Return Γ relative to that at the free height."""
    return _gain(heights, radius, exponent) / _gain(np.array([free]), radius, exponent)


def height_of(r: Recording, test: HeightTest) -> float:
    """Return a run's height [m], at most `free_height`."""
    return min(round(float(np.median(r.height[r.rows(test.window)])), 4), test.free_height)


def sets_by_duty(recordings: Sequence[Recording], test: HeightTest) -> list[dict[float, list[Recording]]]:
    """Return for each duty the recordings by height; most recordings first, the validation duty last."""
    sets: dict[float, dict[float, list[Recording]]] = {}
    for r in recordings:
        duty = round(float(np.median(r.duty[r.rows(test.window)])), 3)
        sets.setdefault(duty, {}).setdefault(height_of(r, test), []).append(r)
    validation = None if test.validation_duty is None else round(test.validation_duty, 3)
    order = sorted(sets, key=lambda d: (d == validation, -sum(map(len, sets[d].values()))))
    return [sets[d] for d in order]


def _thesis(ratios: Array, gains: Array) -> tuple[float, int]:
    """Return the thesis' k, and the number of unusable ratios.

    The estimate fits ln((Γ−1)/Γ) = k·ln(1/(4Z̄)) with weights 1/Z̄.
    """
    good = gains > 1.0
    z, g = np.repeat(ratios[:, None], gains.shape[1], axis=1)[good], gains[good]
    x, y, w = np.log(1.0 / (4.0 * z)), np.log((g - 1.0) / g), 1.0 / z
    value = float((w * x * y).sum() / (w * x * x).sum()) if good.any() else float("nan")
    return value, int((~good).sum())


def _figures(result: Result, ratios: Array, forces: Array, gains: Array) -> list[Figure]:
    estimate = result.estimates[0]
    grid = np.linspace(0.5, 3.3, 90)
    single = forces[:-1] / forces[-1]
    z = np.repeat(ratios, forces.shape[1])

    def curve(k: float) -> Array:
        return _gain(grid, 1.0, k)

    mean, half, _, _ = interval(gains, np.zeros((0, ratios.size)))
    band = ("95 % of k", grid, curve(estimate.high), curve(estimate.low))
    several = [(f"k = {k:g}", grid, curve(k), f"s{n}") for n, k in enumerate((1.5, 1.75, 2.0, 2.25, 2.5))]
    readings = ("single ratios", z, single.ravel(), "dots")
    models = [
        (f"k = {estimate.value:.3f}", grid, curve(estimate.value), "true"),
        ("Cheeseman and Bennett, k = 2", grid, curve(CHEESEMAN_BENNETT), "reference"),
    ]
    axes, title = ("height / radius", "Γ"), "Ground effect over height: means with 95 % intervals"
    bars = [(ratios, mean - half, mean + half)]
    return [
        Figure("Ground effect Γ over height, for several exponents k", *axes, several, counterpart="Fig 4.6"),
        Figure("Ground effect over height: readings and models", *axes, [readings, *models], counterpart="Fig 4.12"),
        Figure(title, *axes, models, band=band, bars=bars, counterpart="Fig 4.13"),
    ]
