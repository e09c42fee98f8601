"""The truth of the blind suite shares nothing with the project, and yet agrees with it and with pencil and paper."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from tests.blind.field_craft import CraftRig
from tests.blind.truth import Study, craft_of, fly, write
from tests.blind.truth_craft import DUTY, REST, STEP, VARIANCE, Command, Craft, Flight

THRUST = 2.4973  # eq 5.36 [N]
GAMMA = 1.142024  # ground effect at 95 mm, model sheet


# -- pencil and paper ---------------------------------------------------------------------------

COAST = math.exp(-0.25 * 3.0 / 0.705)  # of the speed is left after 3 s
# Ixx·φ̈ = (2·L²·T·dΓ/dz − k_t)·φ − d_t·φ̇, with Γ of eq 4.28
SLOPE = -(GAMMA**2) * 1.902 * (0.127 / (4 * 0.095)) ** 1.902 / 0.095
ROLL = [[0.0, 1.0], [-(5.0 - 2 * 0.17145**2 * THRUST / GAMMA * SLOPE) / 0.009377, -0.45 / 0.009377]]
PHI, PHI_DOT = 1e-4 * expm(0.1 * np.array(ROLL))[:, 0]
SPIN = 2 * 0.17145 * THRUST / 0.01023 * 1e-3 * (0.5 - 0.0884 * (1.0 - math.exp(-0.5 / 0.0884)))
close = pytest.approx


@pytest.mark.parametrize(
    ("command", "duration", "start", "expected"),
    [
        # eq 5.36 of a hovering craft; the sheet gives T_N to 5 digits
        (REST, 2.0, {}, dict.fromkeys(("x", "y", "psi", "phi", "ax"), 0.0) | {"thrust_right": close(THRUST, abs=5e-5)}),
        # eq 5.9 of a coasting craft: vx = v₀·e^(−ct/m); the integrator keeps 1e-11
        (
            REST, 3.0, {"vx": 0.4, "psi": 0.3},
            {
                "vx": close(0.4 * COAST, abs=1e-9), "ax": close(-0.25 / 0.705 * 0.4 * COAST, abs=1e-9),
                "x_world": close(0.4 * 0.705 / 0.25 * (1.0 - COAST) * math.cos(0.3), abs=1e-9),
            },
        ),
        # second-order terms in φ are 1e-4 of it, and the sheet's T_N and Γ carry 5 digits
        (REST, 0.1, {"phi": 1e-4}, {"phi": close(PHI, rel=5e-4), "phi_dot": close(PHI_DOT, rel=5e-4)}),
        # eqs 5.13 and 4.29: ψ̇ = 2·L·T·α/Izz·(t − τ·(1 − e^(−t/τ))), sin α = α to 2e-7 at 1 mrad; T_N has 5 digits
        (
            (DUTY, DUTY, 1e-3, -1e-3), 0.5, {},
            {"psi_dot": close(SPIN, rel=2e-5), "phi": close(0.0, abs=1e-12)},
        ),
    ],
)  # fmt: skip
def test_truth_agrees_with_pencil_and_paper(
    command: Command, duration: float, start: dict[str, float], expected: dict[str, float]
) -> None:
    flight = Flight(Craft(), Craft().rest(**start), tolerance=1e-11)
    for _ in range(round(duration / STEP)):
        flight.advance(command)
    end = flight.outputs()
    assert {name: end[name] for name in expected} == expected


# -- logs ---------------------------------------------------------------------


def test_row_k_holds_the_measurement_and_the_command_that_acts_from_it(tmp_path: Path) -> None:
    study = Study(0, "known", {"actuator_delay": {"time": 0.06}}, disturbed=False, position=True, duty_varied=False)
    write(study, tmp_path, duration=4.0)
    header, *lines = (tmp_path / "e1.csv").read_text().splitlines()
    assert header == ",".join(("time", *CraftRig.inputs, *VARIANCE))
    rows = np.array([line.split(",") for line in lines], dtype=float)
    _, course, _ = fly(study, 0, duration=4.0)
    flight = Flight(craft_of(study), course.states[0])
    assert len(rows) == 201
    for row, reading in zip(rows, course.readings, strict=True):
        now = flight.outputs()
        assert [now[channel] for channel in VARIANCE] == reading.tolist()
        # the written commands are the true ones, so nothing but noise is between row and replay: six deviations
        assert np.all(np.abs(row[5:] - reading) < 6 * np.sqrt(list(VARIANCE.values())))
        flight.advance(tuple(row[1:5].tolist()))
