"""Test 5: moment about the tilting axis over the tilt, the motor off (§4.5.5, eq 4.10, App. D.3.5)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.base.arrays import Array
from cosim.model.namespaces import arrays
from plant.bench import Bench
from plant.identification.cells import Cells, force_of
from plant.identification.command_response import low_pass, tilt_response
from plant.identification.estimates import Figure, Result, made, shifts_of
from plant.identification.protocol import Test
from plant.identification.recordings import Recording, alike
from plant.powertrain import assembly_moment, servo_angle


def analyse(
    recordings: Sequence[Recording], cells: Cells, known: Bench, test: Test, truth: Bench | None, *, draw: bool = True
) -> Result:
    """Arm l [m] of M = m_PA·g·l·sin α; ours lets each test have an offset, behind lag and low pass."""
    shapes: dict[bytes, Array] = {}

    def shape(r: Recording) -> Array:
        key = r.servo_duty.tobytes()
        if key not in shapes:
            tilt = tilt_response(known, r.time, r.servo_duty, np.array([known.lag]))[:, 0]
            moment = assembly_moment(arrays(), tilt, known.assembly_mass, known.gravity, 1.0)
            shapes[key] = low_pass(moment, r.step, test.low_pass)
        return shapes[key][r.rows(test.window)]

    def arms(using: Cells) -> Array:
        rows = []
        for r in recordings:
            s, y = shape(r), force_of(r, using, "m", test.rest)[r.rows(test.window)]
            s = s - s.mean()
            rows.append([float(s @ y / (s @ s))])
        return np.array(rows)

    each = arms(cells)
    top = bottom = 0.0
    for r in recordings:
        w = r.rows(test.window)
        alpha = servo_angle(r.servo_duty[w], known.servo_neutral, known.servo_slope)
        basis = assembly_moment(arrays(), alpha, known.assembly_mass, known.gravity, 1.0)
        top += float(basis @ force_of(r, cells, "m", None)[w])
        bottom += float(basis @ basis)
    names = [("assembly_arm", "m", top / bottom, truth.assembly_arm if truth else np.nan)]
    result = Result("moment", made(names, each, shifts_of(arms, cells, "m", each), "Test 5, with an offset a test"))
    step = known.converter_range / known.converter_levels
    moved = float(
        np.ptp(
            [
                np.median(v[k * v.size // 20 : (k + 1) * v.size // 20])
                for r in recordings[:1]
                for v in [r.volts["m"][r.rows(test.window)]]
                for k in range(20)
            ]
        )
    )
    result.more = {"steps_of_converter": moved / step}
    result.notes.append(
        f"Over the whole tilt the cell moves by {moved / step:.1f} steps of the converter ({1000 * moved:.1f} mV): "
        "noise and the low pass, not its resolution, let it be read."
    )
    if draw:
        result.figures = _figures(result, recordings, cells, known, test)
    return result


def _figures(result: Result, recordings: Sequence[Recording], cells: Cells, known: Bench, test: Test) -> list[Figure]:
    w = recordings[0].rows(test.window)
    same = alike(recordings, test.window)
    alpha = servo_angle(recordings[0].servo_duty[w], known.servo_neutral, known.servo_slope)
    angle, arm = np.degrees(alpha), result.estimates[0].value
    model = 1000.0 * assembly_moment(arrays(), alpha, known.assembly_mass, known.gravity, arm)
    data = 1000.0 * np.array([force_of(r, cells, "m", test.rest)[r.rows(test.window)] for r in same])
    some, bars = slice(None, None, max(1, angle.size // 90)), slice(None, None, max(1, angle.size // 12))
    spread = 1.96 * np.sqrt(((data - model) ** 2).sum(axis=0) / max(1, len(same) - 1))
    what = f"m·g·l·sin α, l = {1000 * arm:.4f} mm"
    return [
        Figure(
            "Moment over the tilt",
            "tilt [°]",
            "mN·m",
            [
                ("readings", np.tile(angle[some], len(same)), data[:, some].ravel(), "dots"),
                (what, angle, model, "true"),
            ],
            counterpart="Fig 4.19",
        ),
        Figure(
            "Moment: 95 % of single readings",
            "tilt [°]",
            "mN·m",
            [(what, angle, model, "true")],
            bars=[(angle[bars], (model - spread)[bars], (model + spread)[bars])],
            counterpart="Fig 4.20",
        ),
    ]
