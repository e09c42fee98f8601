"""The truth of the blind suite shares nothing with the project, and yet agrees with it and with pencil and paper."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from cosim.model import Stepper
from plant.hovercraft import Hovercraft
from tests.blind.truth import VARIANCE, craft_of, draw, fly, write
from tests.blind.truth_craft import DUTY, OUTPUTS, STEP, Command, Craft, Flight
from tests.blind.truth_study import BASE, EFFECTS, Study, size

THRUST = 2.4973  # eq 5.36 [N]
GAMMA = 1.142024  # ground effect at 95 mm, model sheet
HOVER: Command = (DUTY, DUTY, 0.0, 0.0)


def flown(
    craft: Craft, command: Command, duration: float, tolerance: float = 1e-11, **start: float
) -> dict[str, float]:
    flight = Flight(craft, craft.rest(**start), tolerance=tolerance)
    for _ in range(round(duration / STEP)):
        flight.advance(command)
    return flight.outputs()


def study_with(name: str, seed: int = 0, **conditions: bool) -> Study:
    values = {name: size(name, np.random.default_rng(seed))}
    told = {"disturbed": False, "position": True, "duty_varied": name == "thrust_slope"} | conditions
    return Study(seed, "known", values, **told)


NOTHING = Study(3, "nothing", {}, disturbed=False, position=True, duty_varied=False)


# -- pencil and paper ---------------------------------------------------------------------------


def test_a_hovering_craft_stays_and_carries_the_nominal_thrust() -> None:
    end = flown(Craft(), HOVER, 2.0)
    # eq 5.36; the sheet gives T_N to 5 digits
    assert end["thrust_right"] == pytest.approx(THRUST, abs=5e-5)
    assert [end[n] for n in ("x", "y", "psi", "phi", "ax")] == [0.0] * 5


def test_a_coasting_craft_loses_speed_exponentially() -> None:
    # eq 5.9 without thrust: vx = v₀·e^(−ct/m); the integrator keeps 1e-11
    end = flown(Craft(), HOVER, 3.0, vx=0.4, psi=0.3)
    left = math.exp(-0.25 * 3.0 / 0.705)
    assert end["vx"] == pytest.approx(0.4 * left, abs=1e-9)
    assert end["x_world"] == pytest.approx(0.4 * 0.705 / 0.25 * (1.0 - left) * math.cos(0.3), abs=1e-9)
    assert end["ax"] == pytest.approx(-0.25 / 0.705 * 0.4 * left, abs=1e-9)


def test_roll_decays_as_its_linear_equation_says() -> None:
    # Ixx·φ̈ = (2·L²·T·dΓ/dz − k_t)·φ − d_t·φ̇, with Γ of eq 4.28
    ratio = (0.127 / (4 * 0.095)) ** 1.902
    slope = -(GAMMA**2) * 1.902 * ratio / 0.095
    stiffness = 5.0 - 2 * 0.17145**2 * THRUST / GAMMA * slope
    a = np.array([[0.0, 1.0], [-stiffness / 0.009377, -0.45 / 0.009377]])
    end = flown(Craft(), HOVER, 0.1, phi=1e-4)
    # second-order terms in φ are 1e-4 of it, and the sheet's T_N and Γ carry 5 digits
    assert [end["phi"], end["phi_dot"]] == pytest.approx(list(expm(0.1 * a) @ [1e-4, 0.0]), rel=5e-4)


def test_a_step_of_differential_tilt_spins_the_craft_up_through_the_lag() -> None:
    # eqs 5.13 and 4.29: ψ̇ = 2·L·T·α/Izz·(t − τ·(1 − e^(−t/τ))), sin α = α to 2e-7 at 1 mrad
    end = flown(Craft(), (DUTY, DUTY, 1e-3, -1e-3), 0.5)
    angle = 2 * 0.17145 * THRUST / 0.01023 * 1e-3
    expected = angle * (0.5 - 0.0884 * (1.0 - math.exp(-0.5 / 0.0884)))
    assert end["psi_dot"] == pytest.approx(expected, rel=2e-5)  # T_N has 5 digits
    assert end["phi"] == pytest.approx(0.0, abs=1e-12)


# -- against itself and against the plant -------------------------------------------------------------


def commands(seed: int, count: int) -> list[Command]:
    """Levels within the log's ranges, four samples each."""
    rng = np.random.default_rng(seed)
    levels = np.repeat(rng.uniform(-1, 1, (count // 4 + 1, 4)) * (0.1, 0.1, 0.2, 0.2), 4, axis=0)[:count]
    return [tuple((level + HOVER).tolist()) for level in levels]  # type: ignore[misc]


START = {"vx": 0.25, "vy": -0.1, "psi": 0.4, "psi_dot": 0.3, "phi": 0.01, "tilt_right": 0.05, "tilt_left": -0.02}


def trajectory(craft: Craft, tolerance: float, count: int = 250) -> np.ndarray:
    flight = Flight(craft, craft.rest(**START), tolerance=tolerance)
    rows = []
    for command in commands(1, count):
        flight.advance(command)
        rows.append(list(flight.outputs().values()))
    return np.array(rows)


def plant_model(study: Study, substep: float) -> Stepper:
    """The project's plant with a study's effects, at a substep of one's own."""
    values = {n if n in BASE else f"{n}.{p}": v for n, parameters in study.truth.items() for p, v in parameters.items()}
    finer = type("Finer", (Hovercraft,), {"substep": substep})
    model = finer().with_values(values)
    return Stepper(model)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["base", *EFFECTS, *BASE])
def test_truth_and_plant_are_the_same_craft(name: str) -> None:
    study = NOTHING if name == "base" else study_with(name)
    # the plant averages a late command over a substep and steps over the rate limit's kink: first-order errors that
    # need 1 ms to be as small as the others' at the plant's own 5 ms
    substep = 0.0005 if name in ("actuator_delay", "servo_rate_limit") else 0.005
    stepper = plant_model(study, substep)
    moment = stepper.start(0.0, START)
    expected = trajectory(craft_of(study), 1e-11)
    names = [q.name for q in stepper.model.outputs]
    for row, command in zip(expected, commands(1, 250), strict=True):
        moment = stepper.step(moment, command, STEP)
        found = dict(zip(names, stepper.output(moment.t, moment.state, command), strict=True))
        # RK4 at 5 ms is good to 1e-6 of the roll rate; dry friction's steep tanh costs ten times that
        assert [found[n] for n in OUTPUTS] == pytest.approx(row.tolist(), abs=1e-5)


# -- logs ------------------------------------------------------------------------------------


def parsed(path: Path) -> dict[str, np.ndarray]:
    header, *rows = path.read_text().splitlines()
    return dict(zip(header.split(","), np.array([r.split(",") for r in rows], dtype=float).T, strict=True))


def test_row_k_holds_the_measurement_and_the_command_that_acts_from_it(tmp_path: Path) -> None:
    study = study_with("actuator_delay")
    write(study, tmp_path, duration=4.0)
    written, log = parsed(tmp_path / "e1.csv"), fly(study, 0, duration=4.0)
    assert len(written["time"]) == 201
    flight = Flight(craft_of(study), craft_of(study).rest(**log.start))
    for k in range(201):
        now = flight.outputs()
        # the written commands are the true ones, so nothing but noise is between row and replay: six deviations
        for channel, variance in VARIANCE.items():
            assert abs(written[channel][k] - now[channel]) < 6 * math.sqrt(variance)
            assert now[channel] == log.noiseless[channel][k]
        flight.advance(tuple(written[n][k] for n in ("duty_right", "duty_left", "tilt_right", "tilt_left")))  # type: ignore[arg-type]


# -- what is drawn ----------------------------------------------------------------------------


STUDIES = [draw(seed) for seed in range(200)]


def test_two_hundred_studies_are_110_known_50_nothing_40_outside() -> None:
    assert Counter(s.kind for s in STUDIES) == {"known": 110, "nothing": 50, "outside": 40}
    assert Counter(s.kind for s in STUDIES[:20]) == {"known": 11, "nothing": 5, "outside": 4}
    assert Counter(s.disturbed for s in STUDIES if s.kind == "nothing") == {True: 25, False: 25}
    # half of all, within four standard errors of √(200/4) = 7
    assert abs(sum(s.disturbed for s in STUDIES) - 100) < 28
