"""Test 3: vertical and horizontal projection of the thrust near the ground (§4.5.3, App. D.3.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.base.arrays import Array
from plant.bench import Bench
from plant.identification.cells import Cells, force_of
from plant.identification.command_response import low_pass, tilt_response
from plant.identification.estimates import Figure, Result, made, shifts_of
from plant.identification.protocol import HoldTest
from plant.identification.recordings import Recording, alike
from plant.powertrain import servo_angle

BIN = np.radians(2.5)


def analyse(
    recordings: Sequence[Recording],
    cells: Cells,
    known: Bench,
    test: HoldTest,
    truth: Bench | None,
    *,
    draw: bool = True,
) -> Result:
    """Factors on cos α and sin α in F_z and F_x over the thrust held upright: 1 where these project it."""
    tilts: dict[bytes, Array] = {}

    def tilt(r: Recording) -> Array:
        key = r.servo_duty.tobytes()
        if key not in tilts:
            tilts[key] = tilt_response(known, r.time, r.servo_duty, np.array([known.lag]))[:, 0]
        return tilts[key]

    def factors(using: Cells) -> Array:
        rows = []
        for r in recordings:
            w, alpha = r.rows(test.window), tilt(r)
            fz, fx = (force_of(r, using, c, test.rest) for c in "zx")
            total = fz[r.rows(test.hold)].mean()
            cos, sin = (low_pass(f(alpha), r.step, test.low_pass)[w] for f in (np.cos, np.sin))
            rows.append([fz[w] @ cos / (cos @ cos) / total, fx[w] @ sin / (sin @ sin) / total])
        return np.array(rows)

    each = factors(cells)
    thesis = _thesis(recordings, cells, known, test)
    one = 1.0 if truth else np.nan
    names = [("vertical_projection", "1", thesis[0], one), ("horizontal_projection", "1", thesis[1], one)]
    result = Result(
        "projection", made(names, each, shifts_of(factors, cells, "zx", each), "Test 3, over cos α and sin α")
    )
    # deviation of the functions themselves, in bins of the angle
    edges = BIN * np.arange(-36, 37)
    deviation: dict[str, Array] = {}
    for k, (c, f) in enumerate((("z", np.cos), ("x", np.sin))):
        measured = []
        for r in recordings:
            w, alpha = r.rows(test.window), tilt(r)
            force = force_of(r, cells, c, test.rest)[w] / force_of(r, cells, "z", test.rest)[r.rows(test.hold)].mean()
            off = force - low_pass(f(alpha), r.step, test.low_pass)[w]
            place = np.digitize(alpha[w], edges)
            measured.append([off[place == j].mean() if (place == j).any() else np.nan for j in range(1, edges.size)])
        with np.errstate(all="ignore"):
            seen = np.isfinite(np.array(measured)).all(axis=0)
        deviation["VH"[k]] = np.array(measured)[:, seen].mean(axis=0)
    largest = {name: float(np.abs(v).max()) for name, v in deviation.items()}
    result.more = {"largest_deviation": largest}
    result.notes.append(
        f"V(α) is off cos α by {largest['V']:.4f} at most, H(α) off sin α by {largest['H']:.4f}, "
        "in bins of 2.5°: sine and cosine project it."
    )
    if draw:
        result.figures = _figures(recordings, cells, known, test, tilt(recordings[0]))
    return result


def _thesis(recordings: Sequence[Recording], cells: Cells, known: Bench, test: HoldTest) -> tuple[float, float]:
    """Against the thrust of the first five rows of the fifth test, at the angle that is commanded, no tare."""
    fifth = recordings[min(4, len(recordings) - 1)]
    total = float(force_of(fifth, cells, "z", None)[fifth.rows(test.window)][:5].mean())
    top, bottom = np.zeros(2), np.zeros(2)
    for r in recordings:
        w = r.rows(test.window)
        alpha = servo_angle(r.servo_duty[w], known.servo_neutral, known.servo_slope)
        for k, (c, f) in enumerate((("z", np.cos), ("x", np.sin))):
            top[k] += force_of(r, cells, c, None)[w] @ f(alpha)
            bottom[k] += f(alpha) @ f(alpha)
    v, h = top / bottom / total
    return float(v), float(h)


def _figures(recordings: Sequence[Recording], cells: Cells, known: Bench, test: HoldTest, alpha: Array) -> list[Figure]:
    gram, found = 1000.0 / known.gravity, []
    w = recordings[0].rows(test.window)
    angle = np.degrees(alpha[w])
    some = slice(None, None, max(1, angle.size // 120))
    order = np.argsort(angle)
    same = alike(recordings, test.window)
    total = gram * np.mean([force_of(r, cells, "z", test.rest)[r.rows(test.hold)].mean() for r in same])
    for c, f, name in (("z", np.cos, "Vertical"), ("x", np.sin, "Horizontal")):
        data = gram * np.array([force_of(r, cells, c, test.rest)[r.rows(test.window)] for r in same])
        model = total * f(np.radians(angle))
        spread = 1.96 * np.sqrt(((data - model) ** 2).sum(axis=0) / max(1, len(same) - 1))
        what = "T·cos α" if c == "z" else "T·sin α"
        found.append(
            Figure(
                f"{name} force over the tilt",
                "tilt [°]",
                "gf",
                [
                    ("readings", np.tile(angle[some], len(same)), data[:, some].ravel(), "dots"),
                    (what, angle[order], model[order], "true"),
                ],
                counterpart="Fig 4.14",
            )
        )
        bars = slice(None, None, max(1, angle.size // 10))
        found.append(
            Figure(
                f"{name} force: 95 % of single readings",
                "tilt [°]",
                "gf",
                [(what, angle[order], model[order], "true")],
                bars=[(angle[bars], (model - spread)[bars], (model + spread)[bars])],
                counterpart="Fig 4.15",
            )
        )
    return found
