"""Tests 3 and 5 over the tilt: projections of the thrust, and the moment of the weight with the motor off.

§4.5.3, App. D.3.3; §4.5.5, eq 4.10, App. D.3.5.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy import stats

from cosim.core.arrays import Array
from cosim.model.namespaces import arrays
from plant.identification.cells import Cells
from plant.identification.estimates import Figure, Measurement, Result, estimated, low_pass
from plant.identification.recordings import Recording
from plant.powertrain import assembly_moment

BIN = np.radians(2.5)


def projection(m: Measurement) -> Result:
    """Return factors on cos α and sin α in F_z and F_x, ideally 1.

    Forces are relative to the thrust held upright.
    """
    test = m.test
    functions: Sequence[tuple[str, str, Any]] = (("z", "vertical", np.cos), ("x", "horizontal", np.sin))

    def runs(c: str, f: Any, using: Cells) -> Iterator[tuple[Array, Array, Array, float]]:
        """Yield tilt, its function after the low pass, and force in the window, and the thrust, of each run."""
        for r in m.recordings:
            w, alpha = m.inside(r), m.tilt(r)
            thrust = float(m.force(r, "z", using)[r.rows(test.hold)].mean())
            yield alpha[w], low_pass(f(alpha), r.step, test.low_pass)[w], m.force(r, c, using)[w], thrust

    def factors(using: Cells) -> Array:
        each = [[y @ s / (s @ s) / thrust for _, s, y, thrust in runs(c, f, using)] for c, _, f in functions]
        return np.array(each).T

    # thesis: thrust of five rows of the fifth test, commanded angle, no tare
    fifth = m.recordings[min(4, len(m.recordings) - 1)]
    total = float(m.printed_force(fifth, "z")[m.inside(fifth)][:5].mean())
    thesis = {f"{name}_projection": m.printed_factor(c, f) / total for c, name, f in functions}
    result = estimated(m, "projection", factors, "zx", thesis, "Test 3, over cos α and sin α")
    # deviation of the functions themselves, in bins of the angle
    edges, largest = BIN * np.arange(-36, 37), {}
    for letter, (c, _, f) in zip("VH", functions, strict=True):
        off = [
            stats.binned_statistic(alpha, y / thrust - s, "mean", edges).statistic  # NaN for an empty bin
            for alpha, s, y, thrust in runs(c, f, m.cells)
        ]
        largest[letter] = float(np.nanmax(np.abs(np.mean(off, axis=0))))
    result.details = {"largest_deviation": largest}
    result.notes.append(
        f"V(α) is off cos α by {largest['V']:.4f} at most, H(α) off sin α by {largest['H']:.4f}, in bins of 2.5°: sine "
        "and cosine project it."
    )
    first, same = m.recordings[0], _equally_long(m)
    alpha = m.tilt(first)[m.inside(first)]
    total = np.mean([m.gram_force(r, "z")[r.rows(test.hold)].mean() for r in same])
    for c, name, f in functions:
        data = np.array([m.gram_force(r, c)[m.inside(r)] for r in same])
        line = (f"T·{f.__name__} α", np.degrees(alpha), total * f(alpha))
        result.figures += _over_tilt(f"{name.capitalize()} force", "gf", data, line, (120, 10), ("4.14", "4.15"))
    return result


def moment(m: Measurement) -> Result:
    """Return the arm l [m] of M = m_PA·g·l·sin α, with an offset for each test."""
    bench = m.bench

    def per_arm(alpha: Array) -> Array:
        return np.asarray(assembly_moment(arrays(), alpha, bench.assembly_mass, bench.gravity, 1.0))

    def arms(using: Cells) -> Array:
        rows = []
        for r in m.recordings:
            s = low_pass(per_arm(m.tilt(r)), r.step, m.test.low_pass)[m.inside(r)]
            s = s - s.mean()
            rows.append([float(s @ m.force(r, "m", using)[m.inside(r)] / (s @ s))])
        return np.array(rows)

    thesis = {"assembly_arm": m.printed_factor("m", per_arm)}
    result = estimated(m, "moment", arms, "m", thesis, "Test 5, with an offset a test")
    first = m.recordings[0]
    volts = first.volts["m"][m.inside(first)]
    twentieths = np.split(volts, [k * volts.size // 20 for k in range(1, 20)])
    change = float(np.ptp([np.median(part) for part in twentieths]))
    steps = change / (bench.converter_range / bench.converter_levels)
    result.details = {"steps_of_converter": steps}
    result.notes.append(
        f"Over the whole tilt the cell moves by {steps:.1f} steps of the converter ({1000 * change:.1f} mV): noise and "
        "the low pass, not its resolution, let it be read."
    )
    alpha, arm = m.commanded_tilt(first)[m.inside(first)], result.estimates[0].value
    line = (f"m·g·l·sin α, l = {1000 * arm:.4f} mm", np.degrees(alpha), 1000.0 * arm * per_arm(alpha))
    data = 1000.0 * np.array([m.force(r, "m")[m.inside(r)] for r in _equally_long(m)])
    result.figures = _over_tilt("Moment", "mN·m", data, line, (90, 12), ("4.19", "4.20"))
    return result


def _equally_long(m: Measurement) -> list[Recording]:
    """Return recordings with the first one's number of rows."""
    count = m.inside(m.recordings[0]).sum()
    return [r for r in m.recordings if m.inside(r).sum() == count]


def _over_tilt(
    name: str,
    unit: str,
    data: Array,
    model: tuple[str, Array, Array],
    drawn: tuple[int, int],
    counterparts: Sequence[str],
) -> list[Figure]:
    """Return the figures of readings and their range over the tilt.

    Args:
        data: Readings, shape (tests, rows).
        model: Label, tilt [°] and value of each row.
        drawn: About how many readings of a test, and how many ranges.
    """
    label, angle, values = model
    some, few = (slice(None, None, max(1, angle.size // count)) for count in drawn)
    spread = 1.96 * np.sqrt(((data - values) ** 2).sum(axis=0) / max(1, len(data) - 1))
    order = np.argsort(angle, kind="stable")
    line = (label, angle[order], values[order], "true")
    readings = ("readings", np.tile(angle[some], len(data)), data[:, some].ravel(), "dots")
    ends = [(angle[few], (values - spread)[few], (values + spread)[few])]
    title, axes, (first, second) = f"{name} over the tilt", ("tilt [°]", unit), counterparts
    return [
        Figure(f"{title}: readings and model", *axes, [readings, line], counterpart=f"Fig {first}"),
        Figure(f"{title}: range of 95 % of the readings", *axes, [line], bars=ends, counterpart=f"Fig {second}"),
    ]
