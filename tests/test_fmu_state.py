"""The FMU state contains everything that determines the future, bit for bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException

from cosim.fmi.fmu_build import build
from fmus.recipes import plant_recipe
from tests.hosts_fmpy import Instance

STEP = 0.02  # [s]
MEMORY = {  # every effect that remembers, delay, play and second-order tilt, and one that reads the time
    "x_start": 1.0,
    "psi_dot_start": 0.3,
    "duty_nominal": 6.4,
    "actuator_delay.time": 0.073,
    "servo_backlash.width": 0.05,
    "actuator_second_order.natural_frequency": 14.0,
    "actuator_second_order.damping_ratio": 0.3,
    "battery_sag.drop": 0.3,
    "roll_ground_effect": False,
}
CONTROLLER = {"x_hat_start": 0.1, "psi_hat_start": 0.05, "estimator": "consistent", "k_1_1": 0.6}
CASES = pytest.mark.parametrize(
    ("which", "values"),
    [("plant_fmu", {}), ("plant_fmu", MEMORY), ("controller_fmu", {}), ("controller_fmu", CONTROLLER),
     ("native_plant", MEMORY)],
    ids=["plant", "plant-memory", "controller", "controller-consistent", "native-plant-memory"],
)  # fmt: skip
Rows = list[dict[str, float]]


def drive(instance: Instance, first: int, last: int) -> Rows:
    """Steps `first` to `last` under inputs that are a function of the step alone."""
    names = instance.names("input")
    rows = []
    for k in range(first, last):
        rng = np.random.default_rng([k, 42])
        values = rng.uniform(-0.2, 0.2, len(names)).tolist()
        inputs = {n: v + 6.4 if n.startswith("duty") else v for n, v in zip(names, values, strict=True)}
        rows.append(instance.step(STEP * k, STEP, inputs))
    return rows


def same(got: Rows, want: Rows) -> None:
    """Bit for bit: repr tells any two floats apart, −0.0 and 0.0 too."""
    assert list(map(repr, got)) == list(map(repr, want))


@CASES
def test_the_future_repeats_after_a_rollback_and_in_another_instance(fmu: Path, values: dict[str, Any]) -> None:
    with Instance(fmu) as instance:
        instance.initialize(values)
        drive(instance, 0, 20)
        before = instance.outputs()
        state, data = instance.call("getFMUstate"), instance.serialized()
        future = drive(instance, 20, 60)
        for _ in range(2):  # a state can be gone back to more than once
            instance.call("setFMUstate", state)
            same([instance.outputs()], [before])
            same(drive(instance, 20, 60), future)
        instance.restore(data)
        same(drive(instance, 20, 60), future)
    assert future[-1] != before
    with Instance(fmu) as fresh:
        fresh.restore(data)
        same(drive(fresh, 20, 60), future)
    with Instance(fmu) as busy:
        drive(busy.initialize(), 0, 5)
        busy.restore(data)
        same(drive(busy, 20, 60), future)


@CASES
def test_a_state_of_initialization_mode_keeps_what_was_set(fmu: Path, which: str, values: dict[str, Any]) -> None:
    other = {"psi_hat_start": 0.1} if which == "controller_fmu" else {"psi_start": 0.7}
    with Instance(fmu) as instance:
        first = instance.begin(values).outputs()
        data = instance.serialized()
        instance.set(other)
        assert instance.outputs() != first
        instance.restore(data)
        same([instance.outputs()], [first])
        instance.call("exitInitializationMode")
        future = drive(instance, 0, 30)
        instance.restore(data)  # from the run back into initialization mode, where parameters can be set again
        instance.set(other)
        instance.call("exitInitializationMode")
        assert drive(instance, 0, 30) != future
    with Instance(fmu) as fresh:
        fresh.restore(data)
        fresh.call("exitInitializationMode")
        same(drive(fresh, 0, 30), future)


@pytest.mark.parametrize("which", ["plant_fmu", "native_plant"])
def test_a_state_of_another_fmu_and_bytes_that_are_none_are_refused(
    fmu: Path, which: str, controller_fmu: Path, native_fmus: Path, tmp_path: Path
) -> None:
    # a plant with the same variables and other defaults: what the state does not name would silently be the taker's
    others = [build(plant_recipe({"mass": 0.9}), tmp_path / "heavier.fmu"), controller_fmu]
    if which == "native_plant":
        others = [native_fmus / "controller-native.fmu"]
    states = [b"", b"{}", b"no state", b"[1, 2]"]
    for path in others:
        with Instance(path) as giver:
            states.append(giver.initialize().serialized())
    for data in states:
        with Instance(fmu) as taker, pytest.raises(FMICallException) as caught:
            taker.initialize().restore(data)
        assert caught.value.status in (3, 4)
