"""The truth of the blind suite shares nothing with the project, and yet agrees with it and with pencil and paper."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from cosim.model import Stepper
from plant.hovercraft import Hovercraft
from tests.blind.field_craft import CraftRig
from tests.blind.truth import BASE, EFFECTS, Study, craft_of, fly, size, write
from tests.blind.truth_craft import DUTY, OUTPUTS, REST, STEP, VARIANCE, Command, Craft, Flight

THRUST = 2.4973  # eq 5.36 [N]
GAMMA = 1.142024  # ground effect at 95 mm, model sheet
START = {"vx": 0.25, "vy": -0.1, "psi": 0.4, "psi_dot": 0.3, "phi": 0.01, "tilt_right": 0.05, "tilt_left": -0.02}


def study_with(name: str) -> Study:
    truth = {} if name == "base" else {name: size(name, np.random.default_rng(0))}
    return Study(0, "known", truth, disturbed=False, position=True, duty_varied=name == "thrust_slope")


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


# -- against the plant --------------------------------------------------------------------------


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["base", *EFFECTS, *BASE])
def test_truth_and_plant_are_the_same_craft(name: str) -> None:
    study, rng = study_with(name), np.random.default_rng(1)
    values = {n if n in BASE else f"{n}.{p}": v for n, effect in study.truth.items() for p, v in effect.items()}
    # the plant averages a late command over a substep and steps over the rate limit's kink: first-order errors that
    # need 1 ms to be as small as the others' at the plant's own 5 ms
    substep = 0.0005 if name in ("actuator_delay", "servo_rate_limit") else 0.005
    stepper = Stepper(type("Finer", (Hovercraft,), {"substep": substep})().with_values(values))
    moment = stepper.start(0.0, START)
    flight = Flight(craft_of(study), craft_of(study).rest(**START), tolerance=1e-11)
    names = [q.name for q in stepper.model.outputs]
    # levels within the log's ranges, four samples each
    levels = np.repeat(rng.uniform(-1, 1, (63, 4)) * (0.1, 0.1, 0.2, 0.2), 4, axis=0)[:250] + REST
    for command in map(tuple, levels.tolist()):
        flight.advance(command)
        moment = stepper.step(moment, command, STEP)
        found = dict(zip(names, stepper.output(moment.t, moment.state, command), strict=True))
        # RK4 at 5 ms is good to 1e-6 of the roll rate; dry friction's steep tanh costs ten times that
        assert [found[n] for n in OUTPUTS] == pytest.approx(list(flight.outputs().values()), abs=1e-5)


# -- logs ---------------------------------------------------------------------


def test_row_k_holds_the_measurement_and_the_command_that_acts_from_it(tmp_path: Path) -> None:
    study = study_with("actuator_delay")
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
