"""Checks of logs: a correct log passes, and each fault is found once, at its place."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.logs.gate import gate, gate_faults
from cosim.logs.log import Log, read_log
from cosim.model import Equations, Model, Namespace, Quantity
from cosim.model.traits import Traits
from plant.hovercraft import INPUTS, OUTPUTS, Hovercraft
from tests.logs import MOVING, RECORDED, STEP, Array, Flight, fly, log_of, measured, times, write_log

Columns = dict[str, Array]


@pytest.fixture(scope="module")
def flight() -> Flight:
    return fly(times(20.0), start=MOVING)


def columns(flight: Flight, **changed: Array) -> Columns:
    return measured(flight, noise=1.0) | changed


CRAFT = Traits.of(Hovercraft())


def serious(log: Log, traits: Traits = CRAFT) -> list[tuple[str, str, str]]:
    return [(f.severity, f.kind, f.channel) for f in gate(log, STEP, traits=traits) if f.severity != "note"]


def test_a_sound_log_passes_without_a_warning(tmp_path: Path, flight: Flight) -> None:
    assert serious(log_of(tmp_path / "a.csv", columns(flight))) == []
    assert serious(log_of(tmp_path / "b.csv", measured(flight))) == []  # without noise as well
    assert serious(read_log(RECORDED, INPUTS, OUTPUTS)) == []


def thinned(keep: Callable[[Array], Array]) -> Callable[[Columns], Columns]:
    return lambda c: {n: v[keep(np.arange(c["time"].size)).astype(bool)] for n, v in c.items()}


def spoilt(name: str, rows: slice, value: float) -> Callable[[Columns], Columns]:
    def change(c: Columns) -> Columns:
        values = c[name].copy()
        values[rows] = value
        return c | {name: values}

    return change


DEFECTS: dict[str, tuple[Any, ...]] = {  # what is done to the log, what is found
    "time in ms": (lambda c: c | {"time": 1000.0 * c["time"]}, ("fault", "rate", "time")),
    "rows twice as far apart": (thinned(lambda k: k % 2 == 0), ("warning", "rate", "time")),
    "rows lost": (thinned(lambda k: ~np.isin(k, [100, *range(200, 203)])), ("warning", "dropouts", "time")),
    "frozen for 12 rows": (spoilt("ax", slice(400, 412), 0.1), ("warning", "frozen", "ax")),
    "too short": (thinned(lambda k: k < 200), ("warning", "short", "time")),
    "gyro dead": (lambda c: c | {"psi_dot": 0.0 * c["psi_dot"]}, ("warning", "constant", "psi_dot")),
    "gyro reversed": (lambda c: c | {"psi_dot": -c["psi_dot"]}, ("fault", "sign", "psi_dot")),
    "gyro 12 % off": (lambda c: c | {"psi_dot": 1.12 * c["psi_dot"]}, ("warning", "scale", "psi_dot")),
    "heading in degrees": (lambda c: c | {"psi": np.degrees(c["psi"])}, ("fault", "degrees", "psi")),
    "spikes": (spoilt("ax", slice(100, 900, 200), 9.0), ("warning", "outliers", "ax")),
    "slow sensor held": (
        lambda c: c | {"x_world": np.repeat(c["x_world"][::5], 5)[: c["time"].size]},
        ("warning", "held", "x_world"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("defect", DEFECTS)
def test_each_defect_is_found_and_nothing_else(tmp_path: Path, flight: Flight, defect: str) -> None:
    change, *expected = DEFECTS[defect]
    assert serious(log_of(tmp_path / "a.csv", change(columns(flight)))) == expected


def test_inputs_that_move_alike_are_noted(tmp_path: Path, flight: Flight) -> None:
    log = log_of(tmp_path / "a.csv", columns(flight) | {"duty_left": 13.0 - flight.commands["duty_right"]})
    assert [f.numbers for f in gate(log, STEP) if f.kind == "alike"] == [{"correlation": pytest.approx(-1.0)}]


def turned(folder: Path, ratio: float, factor: float = 1.0) -> tuple[Log, Traits]:
    """A log of a shaft that swings, seen behind a gear, its rate before it; and what its equations tell."""

    @dataclass(frozen=True, kw_only=True)
    class Shaft(Model):
        title = "Shaft"
        base_states = (Quantity("angle", "rad", "angle of the motor"), Quantity("rate", "rad/s", "its rate"))
        inputs = (Quantity("tilt", "rad", "angle commanded"), Quantity("voltage", "1", "voltage"))
        outputs = (Quantity("angle", "rad", "angle behind the gear"), base_states[1])
        catalogue = ()

        def equations(self, m: Namespace) -> Equations:
            return Equations(
                lambda t, state, command: (state[1], command[1] - state[1]),
                lambda t, state, command: (state[0] / ratio, state[1]),
            )

    time = times(20.0)
    columns = {"time": time, "tilt": 2.0 * np.sin(time), "voltage": np.cos(time), "angle": np.sin(time) / ratio}
    path = write_log(folder / "a.csv", columns | {"rate": factor * np.cos(time)})
    return read_log(path, Shaft.inputs, Shaft.outputs), Traits.of(Shaft())


@pytest.mark.parametrize("ratio", [50.0, -1.0, 180.0 / math.pi])
def test_a_gear_between_an_angle_and_a_rate_is_no_fault(tmp_path: Path, ratio: float) -> None:
    log, traits = turned(tmp_path, ratio)
    assert traits.rates == {}
    assert serious(log, traits=traits) == []
    assert {f.severity for f in gate(log, STEP) if f.channel in ("angle", "rate")} <= {"warning", "note"}  # by names


@pytest.mark.parametrize(("factor", "kind"), [(180.0 / math.pi, "degrees"), (-1.0, "sign")])
def test_a_rate_that_the_equations_say_is_one_is_held_against_its_angle(
    tmp_path: Path, factor: float, kind: str
) -> None:
    log, traits = turned(tmp_path, 1.0, factor)
    assert traits.rates == {"angle": "rate"}
    assert serious(log, traits=traits) == [("fault", kind, "rate")]


def test_a_clock_that_was_set_costs_no_memory(tmp_path: Path, flight: Flight) -> None:
    c = columns(flight)
    c["time"] = np.where(np.arange(c["time"].size) > 400, c["time"] + 9e8, c["time"])
    assert ("warning", "gaps", "time") in serious(log_of(tmp_path / "a.csv", c))


def test_a_fault_stands_at_the_line_of_the_header(tmp_path: Path, flight: Flight) -> None:
    path = write_log(tmp_path / "a.csv", columns(flight, psi_dot=-columns(flight)["psi_dot"]))
    path.write_text("\n\n" + path.read_text())
    log = read_log(path, INPUTS, OUTPUTS)
    (fault,) = gate_faults(log, gate(log, STEP, traits=CRAFT))
    assert (fault.line, fault.column) == (3, 7)
