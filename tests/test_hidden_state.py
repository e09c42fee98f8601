"""Replay of FMUs that keep something no output shows: a rate of the tilt, a play, a delay's commands, a temperature."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from cosim.fmi.building.file import load_model
from cosim.fmi.fmu_build import build
from cosim.logs.log import Log, read_log
from cosim.model import Stepper
from cosim.residuals.compare import ChannelSummary, Comparison, verdict
from cosim.residuals.drive import model_signals
from cosim.residuals.workflow import write_replay
from fmus.recipes import plant_recipe
from plant.hovercraft import Hovercraft
from tests.logs import MOVING, fly, log_of, measured, times, write_log

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
