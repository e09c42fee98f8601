"""Studies in conditions that are not the model's: other noise, rest, a hidden start elsewhere, two lags at once."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from cosim.estimation.posing import build_problem
from cosim.estimation.sensor_noise import noise_warnings
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.experiment.excite import excite
from plant.hovercraft import SENSOR_VARIANCE, Hovercraft
from tests.logs import write_log
from tests.studies import holds, named, proven, study_of

pytestmark = pytest.mark.optimized

MOTOR = '''
from dataclasses import dataclass

from cosim.model import Effect, Equations, Model, Quantity, overrides, parameter


class Load(Effect):
    """A torque that the motor lacks."""

    def torque(self, rate):
        return 0.0


@dataclass(frozen=True, kw_only=True)
class Fan(Load):
    """A fan on the shaft."""

    name = "fan"
    equation = "torque −c·ω²"
    factor: float = parameter(0.0, unit="N.m.s2", bounds=(0, 1e-3), neutral=0.0, typical=2e-6, doc="c")

    def torque(self, rate):
        return -self.factor * rate * rate


@dataclass(frozen=True, kw_only=True)
class Motor(Model):
    """J·ω̇ = k·(u − k·ω)/R; a tachometer reads 0.02·ω."""

    base_states = (Quantity("speed", "rad/s", "of the shaft"),)
    inputs = (Quantity("voltage", "V", "of the armature"),)
    outputs = (Quantity("tacho", "V", "of the tachometer"),)
    catalogue, sensor_variance, forced, calibrated = (Fan,), {"tacho": 1e-4}, ("speed",), ("inertia",)
    inertia: float = parameter(1e-3, unit="kg.m2", bounds=(1e-5, 1), doc="J")
    k: float = parameter(0.05, unit="V.s", bounds=(1e-3, 1), doc="constant of the motor")

    def equations(self, m):
        """With a resistance of 1 Ω."""
        terms = overrides(self.awake, "torque", Load)

        def derivative(t, state, command):
            torque = self.k * (command[0] - self.k * state[0])
            for term in terms:
                torque = torque + term.torque(state[0])
            return (torque / self.inertia,)

        return Equations(derivative, lambda t, state, command: (0.02 * state[0],))
'''


def motor_study(folder: Path, voltage: float, start: float = 0.0) -> Path:
    """A motor that lacks nothing, on steps of its voltage, turning at `start` [rad/s]; exact between the rows."""
    (folder / "motor.py").write_text(MOTOR)
    for seed, name in enumerate("abc"):
        rng = np.random.default_rng(seed)
        u = voltage * np.repeat(rng.uniform(-1, 1, 30), 20)
        speed, tacho = start, []
        for command in u.tolist():
            tacho.append(0.02 * speed)
            speed = 20 * command + (speed - 20 * command) * math.exp(-2.5 * 0.02)  # time constant J/k² = 0.4 s
        seen = np.array(tacho) + 1e-2 * rng.standard_normal(600)
        write_log(folder / f"{name}.csv", {"time": 0.02 * np.arange(600), "voltage": u, "tacho": seen})
    path = folder / "study.yaml"
    path.write_text("model: motor.py:Motor\nlogs: {estimation: [a.csv, b.csv], validation: [c.csv]}\n")
    return path


def shaken(path: Path, level: Mapping[str, float], every: Mapping[str, int]) -> None:
    """Add white noise to columns of a log, and leave one in `every` of the readings of some."""
    with path.open() as stream:
        header, *rows = csv.reader(stream)
    table, rng = np.array(rows, dtype=float), np.random.default_rng(len(path.stem))
    for name, sigma in level.items():
        column = table[:, [h.partition(" ")[0] for h in header].index(name)]
        column += sigma * rng.standard_normal(len(table))
        column[np.arange(len(table)) % every.get(name, 1) != 0] = np.nan
    write_log(path, dict(zip(header, table.T, strict=True)))


@pytest.mark.thorough
def test_a_delay_and_a_second_order_lag_are_found_together(tmp_path: Path) -> None:
    """Each alone fits so well that their first fit together is worse, and must not be given up there."""
    truth = {
        "actuator_delay": {"time": 0.06},
        "actuator_second_order": {"natural_frequency": 14.0, "damping_ratio": 0.45},
    }
    path = study_of(tmp_path / "study", truth, duty_varied=True)
    few = "[actuator_delay, actuator_second_order, servo_backlash, servo_rate_limit]"
    path.write_text(path.read_text().partition("candidates:")[0] + f"candidates: {few}\n")
    r = proven(path, tmp_path / "out")
    assert named(r) == truth.keys()
    assert holds(r, "actuator_delay", "time", 0.06)
    assert holds(r, "actuator_second_order", "natural_frequency", 14.0)


@pytest.mark.thorough
def test_sensors_with_more_noise_than_the_model_says_are_believed_and_slow_ones_dilute_no_friction(
    tmp_path: Path,
) -> None:
    path = study_of(tmp_path / "study", {"coulomb_friction": {"force": 0.05}})
    for name in ("e1.csv", "e2.csv", "v1.csv"):
        shaken(path.parent / name, {"x_world": 3e-3, "y_world": 3e-3}, every={"y_world": 5})
    r = proven(path, tmp_path / "out")
    assert named(r) == {"coulomb_friction"}
    assert holds(r, "coulomb_friction", "force", 0.05)
    (warning,) = r.record["warnings"]
    assert "`noise: {x_world: 0.003" in warning
    assert r.record["noise_floor"]["x_world"] == pytest.approx(
        r.record["error"]["after"]["validation"]["x_world"], rel=0.2
    )
    told = build_problem(ModelSubject.of(Hovercraft()), r.study.logs, noise={"x_world": 3.2e-3, "y_world": 3.2e-3})
    assert (
        noise_warnings(told, told.plain, ModelSubject.of(Hovercraft())) == ()
    )  # a study that says so is not told again


@pytest.mark.thorough
def test_of_a_model_at_rest_nothing_can_be_said(tmp_path: Path) -> None:
    r = proven(motor_study(tmp_path, 0.0), tmp_path / "out")
    assert (r.record["verdict"], {*r.record["rivals"]}) == ("ambiguous", {"fan", "no_effect"})
    found = excite(str(tmp_path / "out"), tmp_path / "flight", limits=["voltage=6"], experiments=4)
    assert min(found.apart.values()) > 10.0


@pytest.mark.thorough
def test_a_hidden_state_may_start_far_from_where_the_model_does(tmp_path: Path) -> None:
    r = proven(motor_study(tmp_path, 6.0, start=200.0), tmp_path / "out")
    assert r.record["verdict"] == "no_effect"
    assert 60.0 < math.sqrt(r.problem.P0[0, 0]) < 300.0  # steady states reach from −120 to 120 rad/s


@pytest.mark.thorough
def test_a_scaled_reading_is_held_against_a_floor_of_its_own(tmp_path: Path) -> None:
    path = study_of(tmp_path / "study", {"accelerometer_scale": {"value": 1.6}})
    path.write_text(path.read_text().partition("candidates:")[0] + "candidates: [accelerometer_scale, mass]\n")
    r = proven(path, tmp_path / "out")
    assert named(r) == {"accelerometer_scale"}
    after = r.record["error"]["after"]["estimation"]["ax"]
    assert after == pytest.approx(r.record["noise_floors"]["estimation"]["ax"], rel=0.05)
    assert after < 0.8 * math.sqrt(SENSOR_VARIANCE["ax"])  # the readings are divided by 1.6, and their noise with them
