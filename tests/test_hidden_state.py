"""Replay of FMUs that keep something no output shows: a rate of the tilt, a play, a delay's commands, a temperature."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosim.fmi.building.file import load_model
from cosim.fmi.fmu_build import build
from cosim.logs.log import Log, read_log
from cosim.model import Stepper
from cosim.residuals import starts
from cosim.residuals.compare import ChannelSummary, Comparison
from cosim.residuals.drive import Drive, model_signals
from cosim.residuals.replay_sentences import verdict
from cosim.residuals.starts import start_parameters
from cosim.residuals.windows import free_run, self_started
from cosim.residuals.workflow import write_replay
from fmus.recipes import plant_recipe
from plant.hovercraft import Hovercraft
from tests.logs import IMU, MOVING, fly, log_of, measured, times, write_log

REMEMBER = {
    "second order": {"actuator_second_order.natural_frequency": 12.0, "actuator_second_order.damping_ratio": 0.4},
    "play": {"servo_backlash.width": 0.1},
    "delay": {"actuator_delay.time": 0.06},
}
NOTHING = "nothing that the model lacks"

OVEN = '''
from dataclasses import dataclass

from cosim.model import Equations, Model, Quantity, parameter


@dataclass(frozen=True, kw_only=True)
class Oven(Model):
    """A heated block, and a probe on it that is slow to follow; nobody measures the block."""

    base_states = (Quantity("block", "K", "of the block", 293.0), Quantity("probe", "K", "of the probe", 293.0))
    inputs = (Quantity("power", "W", "of the heater"),)
    outputs = (Quantity("probe", "K", "of the probe"),)
    forced = ("block",)
    rate = 1.0
    substep = 0.25
    loss: float = parameter(0.8, unit="W/K", bounds=(0, 50), doc="loss to the room")

    def equations(self, m):
        """C·Ṫ = P − h·(T − 293 K); τ·Ṡ = T − S."""

        def derivative(t, state, command):
            block, probe = state
            return (command[0] - self.loss * (block - 293.0)) / 200.0, (block - probe) / 8.0

        return Equations(derivative, lambda t, state, command: (state[1],))
'''


def craft_log(folder: Path, values: Mapping[str, float]) -> Log:
    """Twelve seconds of a craft with these effects, with the sheet's noise."""
    return log_of(folder / "a.csv", measured(fly(times(12.0), Hovercraft().with_values(values), MOVING), noise=1.0))


def psi(comparison: Comparison) -> ChannelSummary:
    return next(c for c in comparison.channels if c.name == "psi")


@pytest.mark.thorough
@pytest.mark.parametrize("values", REMEMBER.values(), ids=REMEMBER)
def test_a_craft_that_remembers_is_explained_by_its_own_fmu_only(
    values: dict[str, float], tmp_path: Path, plant_fmu: Path
) -> None:
    log = craft_log(tmp_path, values)
    own = write_replay(tmp_path, log, build(plant_recipe(values), tmp_path / "own.fmu"), report=False)
    assert [c.name for c in own.channels if not c.is_matched] == []
    assert NOTHING in verdict(own)
    # ψ is known to some 0.3° from half a second of a gyro; hidden states at their defaults would make 5° and more
    assert psi(own).scores[2.0].rmse < math.radians(1.0)
    base = write_replay(tmp_path, log, plant_fmu, report=False)
    assert psi(base).excess > 4.0 * psi(base).floor.limit
    assert NOTHING not in verdict(base)


@pytest.mark.thorough
def test_restarted_from_its_own_outputs_an_fmu_of_ours_is_on_its_free_run(tmp_path: Path) -> None:
    """Nothing is lost between two windows: play, delay and tilt rate are put back bit for bit."""
    values = {name: value for effect in REMEMBER.values() for name, value in effect.items()}
    fmu = build(plant_recipe(values), tmp_path / "own.fmu")
    log = log_of(tmp_path / "a.csv", measured(fly(times(6.0), Hovercraft().with_values(values), MOVING), IMU))
    with Drive(log, fmu) as driven:
        free, parameters = free_run(driven, {}), start_parameters(driven)
        seen = replace(log, outputs={name: free.outputs[name] for name in IMU})
        again = self_started(driven.on(seen), parameters, free, 0.5)
    assert again is not None
    for name, found in again.outputs.items():
        rows = np.isfinite(found)
        assert found[rows] == pytest.approx(free.outputs[name][rows], abs=1e-9), name  # sums over some hundred steps


@pytest.mark.thorough
def test_windows_of_an_fmu_whose_state_cannot_be_set_are_no_measure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = REMEMBER["second order"]
    monkeypatch.setattr(starts, "_with_places", lambda drive, found: found)  # as of another tool
    fmu = build(plant_recipe(values), tmp_path / "own.fmu")
    comparison = write_replay(tmp_path, craft_log(tmp_path, values), fmu)
    told = verdict(comparison)
    assert psi(comparison).lost
    assert math.isnan(psi(comparison).excess)
    assert NOTHING not in told
    assert "do not measure psi" in told
    assert "keeps a state that no output shows" in told
    assert {f.channel for f in comparison.findings if f.kind == "hidden_state"} >= {"psi", "psi_dot"}
    assert "Restarted from its own outputs" in (tmp_path / "report.html").read_text(encoding="utf-8")


# -- slow rows --------------------------------------------------------------------------------


def test_an_oven_that_loses_more_is_told_from_one_that_does_not(tmp_path: Path) -> None:
    (tmp_path / "oven.py").write_text(OVEN, encoding="utf-8")
    oven = load_model("oven.py:Oven", tmp_path)
    fmu = build(oven.recipe(), tmp_path / "oven.fmu")
    time = times(500.0, 1.0)
    power = 60.0 + 40.0 * np.sign(np.sin(time / 30.0))
    for loss in (0.8, 1.2):
        stepper = Stepper(oven.model.with_values({"loss": loss}))
        moment, probe = stepper.start(), []
        for p in power.tolist():
            probe.append(moment.state[1])
            moment = stepper.step(moment, (p,), 1.0)
        noisy = np.array(probe) + 0.05 * np.random.default_rng(3).standard_normal(time.size)
        path = write_log(tmp_path / "a.csv", {"time": time, "power": power, "probe": noisy})
        comparison = write_replay(tmp_path, read_log(path, *model_signals(fmu)), fmu, report=False)
        assert (NOTHING in verdict(comparison)) == (loss == 0.8)
