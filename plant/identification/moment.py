"""Test 5: moment about the tilting axis over the tilt, motor off (§4.5.5, eq 4.10, App. D.3.5)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cosim.base.arrays import Array
from cosim.model.namespaces import arrays
from plant.identification.cells import Cells
from plant.identification.command_response import low_pass, tilt_response
from plant.identification.estimates import Figure, Measured, Result, make_estimates, out_of_line, shifts_of
from plant.identification.misfit import drift
from plant.identification.recordings import Recording
from plant.powertrain import assembly_moment, servo_angle


def analyse(m: Measured, *, draw: bool = True) -> Result:
    """Return the arm l [m] of M = m_PA·g·l·sin α, with an offset for each test."""
    known, window = m.known, m.test.window
    shapes: dict[bytes, Array] = {}

    def shape(r: Recording) -> Array:
        key = r.servo_duty.tobytes()
        if key not in shapes:
            tilt = tilt_response(known, r.time, r.servo_duty, np.array([known.lag]))[:, 0]
            moment = assembly_moment(arrays(), tilt, known.assembly_mass, known.gravity, 1.0)
            shapes[key] = low_pass(moment, r.step, m.test.low_pass)
        return shapes[key][r.rows(window)]

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
        alpha = servo_angle(r.servo_duty[w], known.servo_neutral, known.servo_slope)
        basis = assembly_moment(arrays(), alpha, known.assembly_mass, known.gravity, 1.0)
        top += float(basis @ m.printed_force(r, "m")[w])
        bottom += float(basis @ basis)
    names = [("assembly_arm", "m", top / bottom, m.true("assembly_arm"))]
    result = Result(
        "moment", make_estimates(names, each, shifts_of(arms, m.cells, "m", each), "Test 5, with an offset a test")
    )
    result.odd += out_of_line([("the arm [m]", m.recordings, each[:, 0])])
    _judge(m, result, shape)
    step = known.converter_range / known.converter_levels
    volts = m.recordings[0].volts["m"][m.recordings[0].rows(window)]
    twentieths = [volts[k * volts.size // 20 : (k + 1) * volts.size // 20] for k in range(20)]
    moved = float(np.ptp([np.median(part) for part in twentieths]))
    result.more = {"steps_of_converter": moved / step}
    result.notes.append(
        f"Over the whole tilt the cell moves by {moved / step:.1f} steps of the converter ({1000 * moved:.1f} mV): "
        "noise and the low pass, not its resolution, let it be read."
    )
    if draw:
        result.figures = _figures(result, m)
    return result


def _judge(m: Measured, result: Result, shape: Callable[[Recording], Array]) -> None:
    """Add a fault for a cell without response to the sweep, and a warning for drift."""
    window = m.test.window
    times = [r.time[r.rows(window)] - window[0] for r in m.recordings]
    moments = [m.force(r, "m")[r.rows(window)] for r in m.recordings]
    shapes = [shape(r) for r in m.recordings]
    constant = [np.ones_like(t) for t in times]
    sweep = drift(moments, [np.column_stack(pair) for pair in zip(constant, shapes, strict=True)])
    if sweep is not None and not sweep.above_noise:
        result.faults.append(
            "volts_m does not answer the sweep of the tilt, beyond its noise: look at the cell, its plug and its wires"
        )
        return
    bases = [np.column_stack(row) for row in zip(constant, shapes, times, strict=True)]

    def slopes(using: Cells) -> Array:
        """Return the residual slope of each recording."""
        rows = []
        for r, basis in zip(m.recordings, bases, strict=True):
            rows.append(np.linalg.lstsq(basis, m.force(r, "m", using)[r.rows(window)], rcond=None)[0][-1:])
        return np.array(rows)

    calibration = shifts_of(slopes, m.cells, "m")
    found = drift(moments, bases, float(np.sqrt((calibration**2).sum())))
    if found is None or not found.significant:
        return
    # change of the arm by the drift, from its projection on the shape
    moved = [
        float((s - s.mean()) @ t / ((s - s.mean()) @ (s - s.mean()))) * slope
        for s, t, slope in zip(shapes, times, found.each, strict=True)
    ]
    arm, shift = result.estimates[0].value, float(np.mean(moved))
    file = m.recordings[found.worst].label
    result.warnings.append(
        f"cell m drifts by {found.mean * (window[1] - window[0]):.2g} N·m over the sweep (most beyond its noise in "
        f"{file}), by which the arm is off some {shift:.2g} m of {arm:.3g} m: let the bench warm up, sweep faster, or "
        "sweep there and back"
    )


def _figures(result: Result, m: Measured) -> list[Figure]:
    first, same, known = m.recordings[0], m.alike(), m.known
    alpha = servo_angle(first.servo_duty[first.rows(m.test.window)], known.servo_neutral, known.servo_slope)
    angle, arm = np.degrees(alpha), result.estimates[0].value
    model = 1000.0 * assembly_moment(arrays(), alpha, known.assembly_mass, known.gravity, arm)
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
