"""Test 3: vertical and horizontal projection of the thrust near the ground (§4.5.3, App. D.3.3)."""

from __future__ import annotations

import numpy as np

from cosim.base.arrays import Array
from plant.identification import messages
from plant.identification.cells import Cells
from plant.identification.command_response import low_pass
from plant.identification.estimates import Figure, Measurement, Result, make_estimates, shifts_of
from plant.powertrain import servo_angle

BIN = np.radians(2.5)


def analyse(m: Measurement, *, draw: bool = True) -> Result:
    """Return factors on cos α and sin α in F_z and F_x, ideally 1.

    Forces are relative to the thrust held upright.
    """
    recordings, test = m.recordings, m.test

    def factors(using: Cells) -> Array:
        rows = []
        for r in recordings:
            w, alpha = r.rows(test.window), m.tilt(r)
            fz, fx = (m.force(r, c, using) for c in "zx")
            total = fz[r.rows(test.hold)].mean()
            cos, sin = (low_pass(f(alpha), r.step, test.low_pass)[w] for f in (np.cos, np.sin))
            rows.append([fz[w] @ cos / (cos @ cos) / total, fx[w] @ sin / (sin @ sin) / total])
        return np.array(rows)

    each = factors(m.cells)
    thesis = _thesis(m)
    one = 1.0 if m.truth else np.nan
    names = [("vertical_projection", "1", thesis[0], one), ("horizontal_projection", "1", thesis[1], one)]
    shifts = shifts_of(factors, m.cells, "zx", each)
    result = Result("projection", make_estimates(names, each, shifts, "Test 3, over cos α and sin α"))
    # deviation of the functions themselves, in bins of the angle
    edges = BIN * np.arange(-36, 37)
    deviation: dict[str, Array] = {}
    for k, (c, f) in enumerate((("z", np.cos), ("x", np.sin))):
        measured = []
        for r in recordings:
            w, alpha = r.rows(test.window), m.tilt(r)
            force = m.force(r, c)[w] / m.force(r, "z")[r.rows(test.hold)].mean()
            off = force - low_pass(f(alpha), r.step, test.low_pass)[w]
            place = np.digitize(alpha[w], edges)
            measured.append([off[place == j].mean() if (place == j).any() else np.nan for j in range(1, edges.size)])
        with np.errstate(all="ignore"):
            filled = np.isfinite(np.array(measured)).all(axis=0)
        deviation["VH"[k]] = np.array(measured)[:, filled].mean(axis=0)
    largest = {name: float(np.abs(v).max()) for name, v in deviation.items()}
    result.details = {"largest_deviation": largest}
    result.notes.append(messages.PROJECTIONS(vertical=largest["V"], horizontal=largest["H"]))
    if draw:
        result.figures = _figures(m, m.tilt(recordings[0]))
    return result


def _thesis(m: Measurement) -> tuple[float, float]:
    """Return the thesis' factors: five rows of the fifth test, commanded angle, no tare."""
    fifth = m.recordings[min(4, len(m.recordings) - 1)]
    total = float(m.printed_force(fifth, "z")[fifth.rows(m.test.window)][:5].mean())
    top, bottom = np.zeros(2), np.zeros(2)
    for r in m.recordings:
        w = r.rows(m.test.window)
        alpha = servo_angle(r.servo_duty[w], m.bench.servo_neutral, m.bench.servo_slope)
        for k, (c, f) in enumerate((("z", np.cos), ("x", np.sin))):
            top[k] += m.printed_force(r, c)[w] @ f(alpha)
            bottom[k] += f(alpha) @ f(alpha)
    v, h = top / bottom / total
    return float(v), float(h)


def _figures(m: Measurement, alpha: Array) -> list[Figure]:
    window, same, figures = m.test.window, m.alike(), []
    angle = np.degrees(alpha[m.recordings[0].rows(window)])
    some, bars = slice(None, None, max(1, angle.size // 120)), slice(None, None, max(1, angle.size // 10))
    order = np.argsort(angle)
    total = m.gram * np.mean([m.force(r, "z")[r.rows(m.test.hold)].mean() for r in same])
    for c, f, name in (("z", np.cos, "Vertical"), ("x", np.sin, "Horizontal")):
        data = m.gram * np.array([m.force(r, c)[r.rows(window)] for r in same])
        model = total * f(np.radians(angle))
        spread = 1.96 * np.sqrt(((data - model) ** 2).sum(axis=0) / max(1, len(same) - 1))
        readings = ("readings", np.tile(angle[some], len(same)), data[:, some].ravel(), "dots")
        line = (f"T·{f.__name__} α", angle[order], model[order], "true")
        ends = [(angle[bars], (model - spread)[bars], (model + spread)[bars])]
        title, axes = f"{name} force", ("tilt [°]", "gf")
        heading = f"{title} over the tilt: readings and model"
        figures.append(Figure(heading, *axes, [readings, line], counterpart="Fig 4.14"))
        heading = f"{title} over the tilt: range of 95 % of the readings"
        figures.append(Figure(heading, *axes, [line], bars=ends, counterpart="Fig 4.15"))
    return figures
