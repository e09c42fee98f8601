"""The FMU state holds everything that decides the future, bit for bit."""

from __future__ import annotations

from collections.abc import Callable
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


@pytest.fixture
def fmu(which: str, request: pytest.FixtureRequest) -> Path:
    path: Path = request.getfixturevalue(which)
    return path


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


def through_handle(instance: Instance) -> Callable[[], None]:
    state = instance.call("getFMUstate")
    return lambda: instance.call("setFMUstate", state)


def through_bytes(instance: Instance) -> Callable[[], None]:
    data = instance.serialized()
    return lambda: instance.restore(data)


@CASES
@pytest.mark.parametrize("way", [through_handle, through_bytes])
def test_the_future_repeats_after_a_rollback(
    fmu: Path, values: dict[str, Any], way: Callable[[Instance], Callable[[], None]]
) -> None:
    with Instance(fmu) as instance:
        instance.initialize(values)
        drive(instance, 0, 20)
        before = instance.outputs()
        back = way(instance)
        future = drive(instance, 20, 60)
        for _ in range(2):  # a state can be gone back to more than once
            back()
            same([instance.outputs()], [before])
            same(drive(instance, 20, 60), future)
    assert future[-1] != before


@CASES
def test_a_state_moves_into_another_instance(fmu: Path, values: dict[str, Any]) -> None:
    with Instance(fmu) as one:
        one.initialize(values)
        drive(one, 0, 20)
        data = one.serialized()
        future = drive(one, 20, 60)
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
        same(drive(fresh.initialize(values), 0, 30), future)
    with Instance(fmu) as fresh:
        fresh.restore(data)
        fresh.call("exitInitializationMode")
        same(drive(fresh, 0, 30), future)


@pytest.mark.parametrize(
    ("giver", "taker"),
    [
        ("plant_fmu", "controller_fmu"),
        ("controller_fmu", "plant_fmu"),
        ("plant_fmu", "heavier"),
        ("native_plant", "native_controller"),
    ],
)
def test_a_state_of_another_fmu_is_refused(
    giver: str, taker: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    # a plant with the same variables and other defaults: what the state does not name would silently be the taker's
    path = {name: request.getfixturevalue(name) for name in (giver, taker) if name.endswith(("fmu", "plant"))}
    if taker == "native_controller":
        path[taker] = path[giver].with_name("controller-native.fmu")
    if taker == "heavier":
        path[taker] = build(plant_recipe({"mass": 0.9}), tmp_path / "heavier.fmu")
    with Instance(path[giver]) as one:
        one.initialize()
        data = one.serialized()
    with Instance(path[taker]) as other:
        other.initialize()
        with pytest.raises(FMICallException) as caught:
            other.restore(data)
        assert caught.value.status in (3, 4)
        assert "of another FMU" in other.log[-1]


@pytest.mark.parametrize("data", [b"", b"{}", b"no state", b"[1, 2]"])
def test_bytes_that_are_no_state_are_refused(plant_fmu: Path, data: bytes) -> None:
    with Instance(plant_fmu) as plant:
        plant.initialize()
        with pytest.raises(FMICallException) as caught:
            plant.restore(data)
        assert caught.value.status in (3, 4)
