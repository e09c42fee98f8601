"""Test 5: moment about the tilting axis as a function of the tilt, motor off (§4.5.5, eq 4.10, App. D.3.5)."""

from __future__ import annotations

import numpy as np

from cosim.base.arrays import Array
from cosim.model.namespaces import arrays
from plant.identification import messages
from plant.identification.cells import Cells
from plant.identification.command_response import low_pass
from plant.identification.estimates import (
    Figure,
    Measurement,
    Result,
    make_estimates,
    shifts_of,
)
from plant.identification.recordings import Recording
from plant.powertrain import assembly_moment, servo_angle


def analyse(m: Measurement, *, draw: bool = True) -> Result:
    """Return the arm l [m] of M = m_PA·g·l·sin α, with an offset for each test."""
    bench, window = m.bench, m.test.window

    def shape(r: Recording) -> Array:
        moment = assembly_moment(arrays(), m.tilt(r), bench.assembly_mass, bench.gravity, 1.0)
        return low_pass(np.asarray(moment), r.step, m.test.low_pass)[r.rows(window)]

    def arms(using: Cells) -> Array:
        rows = []
        for r in m.recordings:
            s, y = shape(r), m.force(r, "m", using)[r.rows(window)]
            s = s - s.mean()
            rows.append([float(s @ y / (s @ s))])
        return np.array(rows)

    each = arms(m.cells)
    top = bottom = 0.0
    for r in m.recordings:
        w = r.rows(window)
        alpha = servo_angle(r.servo_duty[w], bench.servo_neutral, bench.servo_slope)
        basis = assembly_moment(arrays(), alpha, bench.assembly_mass, bench.gravity, 1.0)
        top += float(basis @ m.printed_force(r, "m")[w])
        bottom += float(basis @ basis)
    names = [("assembly_arm", "m", top / bottom, m.true("assembly_arm"))]
    result = Result(
        "moment", make_estimates(names, each, shifts_of(arms, m.cells, "m", each), "Test 5, with an offset a test")
    )
    step = bench.converter_range / bench.converter_levels
    volts = m.recordings[0].volts["m"][m.recordings[0].rows(window)]
    twentieths = [volts[k * volts.size // 20 : (k + 1) * volts.size // 20] for k in range(20)]
    change = float(np.ptp([np.median(part) for part in twentieths]))
    result.details = {"steps_of_converter": change / step}
    result.notes.append(messages.CONVERTER_STEPS(steps=change / step, change=1000 * change))
    if draw:
        result.figures = _figures(result, m)
    return result


def _figures(result: Result, m: Measurement) -> list[Figure]:
    first, same, bench = m.recordings[0], m.alike(), m.bench
    alpha = servo_angle(first.servo_duty[first.rows(m.test.window)], bench.servo_neutral, bench.servo_slope)
    angle, arm = np.degrees(alpha), result.estimates[0].value
    model = 1000.0 * assembly_moment(arrays(), alpha, bench.assembly_mass, bench.gravity, arm)
    data = 1000.0 * np.array([m.force(r, "m")[r.rows(m.test.window)] for r in same])
    some, bars = slice(None, None, max(1, angle.size // 90)), slice(None, None, max(1, angle.size // 12))
    spread = 1.96 * np.sqrt(((data - model) ** 2).sum(axis=0) / max(1, len(same) - 1))
    readings = ("readings", np.tile(angle[some], len(same)), data[:, some].ravel(), "dots")
    line = (f"m·g·l·sin α, l = {1000 * arm:.4f} mm", angle, model, "true")
    ends = [(angle[bars], (model - spread)[bars], (model + spread)[bars])]
    axes = ("tilt [°]", "mN·m")
    return [
        Figure("Moment over the tilt: readings and model", *axes, [readings, line], counterpart="Fig 4.19"),
        Figure("Moment over the tilt: range of 95 % of the readings", *axes, [line], bars=ends, counterpart="Fig 4.20"),
    ]
