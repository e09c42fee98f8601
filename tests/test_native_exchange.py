"""Native plants in the hands of a solver: the equations in Python, and an event for all that is discrete."""

from __future__ import annotations

import json
import math
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu

from cosim.core.errors import SimulationError
from cosim.files.results import Results
from cosim.fmi.building.build import build_native
from cosim.fmi.building.file import load_model
from cosim.simulation.workflow import run
from plant.hovercraft import Hovercraft
from tests.instants import instants_fmu
from tests.logs import write_log
from tests.native import NEEDS_COMPILER
from tests.tank import MODEL as TANK
from tests.test_effects import EVERYTHING, MEMORY, MOVING, Fine, named
from tests.test_native import STEP, TIGHT, by_fmu, by_python, difference, wandering

pytestmark = NEEDS_COMPILER
EXCHANGE = "model-exchange"
STARTS = {f"{name}_start": v for name, v in (MOVING | MEMORY).items()}
INPUTS, OUTPUTS = ([q.name for q in signals] for signals in (Hovercraft.inputs, Hovercraft.outputs))


def flown(folder: Path, fmu: Path, values: dict[str, Any], rows: Any = (), interface: str = EXCHANGE) -> Results:
    """Run an FMU with rows of inputs of a plant, each held for a step."""
    instants_fmu(folder / "e.fmu")
    components: dict[str, Any] = {"m": {"fmu": str(fmu), "interface": interface, "start": values}}
    if len(rows):
        columns = dict(zip(INPUTS, np.array(rows).T, strict=True))
        file = write_log(folder / "u.csv", {"time": STEP * np.arange(len(rows))} | columns)
        components["u"] = {"block": "playback", "file": str(file)}
    if interface == EXCHANGE:
        components["e"] = {"fmu": "e.fmu", "event_mode": True}  # with it all events are listed
    content = {
        "name": "s", "step": STEP, "duration": STEP * (len(rows) or 50), "tolerance": 1e-9, "components": components,
        "connections": [{"from": f"u.{name}", "to": f"m.{name}"} for name in INPUTS if len(rows)],
    }  # fmt: skip
    (folder / "s.json").write_text(json.dumps(content))
    return run(folder / "s.json", folder / "out", report=False, in_process=True, force=True).results


def times(results: Results, cause: str) -> list[float]:
    return [t for t, *found in results.events if found == ["m", cause]]


@pytest.mark.parametrize("more", [{}, {"actuator_delay.time": 0.0335, "servo_backlash.width": 0.05}], ids=str)
def test_a_solver_that_stops_at_events_finds_what_the_python_equations_say(
    more: dict[str, float], native_plant: Path, tmp_path: Path
) -> None:
    rows, values = wandering(Hovercraft(), 100), (more or named(EVERYTHING)) | STARTS
    found = flown(tmp_path, native_plant, values, rows)
    columns = np.column_stack([found[f"m.{name}"][1:] for name in OUTPUTS])
    # whole substeps of delay: nothing is blurred by the mean over a substep
    assert difference(by_python(Fine(), rows, values, STEP), columns) < 1e-6
    assert len(times(found, "time event")) > 90  # where commands arrive


def test_a_late_command_is_an_event_of_its_own(native_plant: Path, tmp_path: Path) -> None:
    rows = np.tile(Hovercraft().start_command(), (80, 1))
    rows[50:, 2], rows[60:, 2] = 0.1, 0.2  # from 1 s and 1.2 s on
    found = flown(tmp_path, native_plant, {"actuator_delay.time": 0.3}, rows)
    assert times(found, "time event") == pytest.approx([1.3, 1.5], abs=1e-9)
    tilt = found["m.tilt_right_actual"]
    assert tilt[65] == 0.0
    assert tilt[75] == pytest.approx(0.1 * (1.0 - math.exp(-0.2 / 0.0884)), abs=1e-7)


@pytest.mark.parametrize("values", [{}, {"servo_rate_limit.rate": 0.5}], ids=str)
def test_a_kink_is_a_state_event_and_none_while_its_effect_sleeps(
    values: dict[str, float], native_plant: Path, tmp_path: Path
) -> None:
    rows = np.tile(Hovercraft().start_command(), (20, 1))
    rows[:, 2] = 0.1
    limit = [(0.1 - 0.5 * 0.0884) / 0.5] if values else []  # from then on the servo is slower by itself
    found = flown(tmp_path, native_plant, values, rows)
    assert times(found, "state event") == pytest.approx(limit, abs=1e-7)


@pytest.mark.parametrize("effect", ["", "actuator_delay.time", "servo_backlash.width"])
def test_moving_inputs_are_refused_where_something_remembers_and_taken_elsewhere(
    effect: str, native_plant: Path
) -> None:
    moving = np.array([(0.0, 0.0), (1.0, 0.1)], dtype=[("time", float), ("tilt_right", float)])
    with pytest.raises(FMICallException) if effect else nullcontext():
        fmpy.simulate_fmu(
            str(native_plant), fmi_type="ModelExchange", solver="CVode", start_values={effect: 0.05} if effect else {},
            input=moving, stop_time=0.1,
        )  # fmt: skip


COUNTING = '''

@dataclass(frozen=True, kw_only=True)
class Slow(TankEffect):
    """A valve that follows: p ← p + (q − p)·h/τ."""

    name = "slow"
    equation = "p ← p + (q − p)·h/τ"
    memory = (Quantity("flow", "m3/s", "flow after the valve"),)

    time: float = parameter(0.0, unit="s", bounds=(0, 100), neutral=0.0, typical=5.0, doc="time constant τ")

    def shape(self, m: Namespace, t: Number, h: Number, command: Values, memory: Values) -> tuple[Values, Values]:
        flow = memory[0] + (command[0] - memory[0]) * h / self.time
        return (flow,), (flow,)


@dataclass(frozen=True, kw_only=True)
class Tank(Model):'''


def test_an_effect_that_counts_substeps_is_for_co_simulation_alone(tmp_path: Path) -> None:
    text = TANK.replace("\n\n@dataclass(frozen=True, kw_only=True)\nclass Tank(Model):", COUNTING)
    (tmp_path / "tank.py").write_text(text.replace("(Leak, Draw)", "(Slow, Leak, Draw)"), encoding="utf-8")
    (built,) = build_native(tmp_path, f"{tmp_path}/tank.py:Tank")
    model = load_model(f"{tmp_path}/tank.py:Tank", Path()).model
    rows: list[tuple[float, ...]] = [(0.02 + 0.01 * (k % 9),) for k in range(60)]
    values = {"slow.time": 4.0}
    assert difference(by_python(model, rows, values, 0.5), by_fmu(built.path, rows, values, 0.5)) < TIGHT
    flown(tmp_path, built.path, {})
    with pytest.raises(SimulationError, match="slow depends on substeps"):
        flown(tmp_path, built.path, values)


@pytest.mark.thorough
def test_fmi_3_says_the_same(native_plant: Path, tmp_path: Path) -> None:
    plant, controller = (built.path for built in build_native(tmp_path, "hovercraft", fmi=3))
    assert validate_fmu(str(plant)) == validate_fmu(str(controller)) == []
    values, rows = named(EVERYTHING) | {"roll_ground_effect": False}, wandering(Hovercraft(), 20)
    for way in ("co-simulation", EXCHANGE):
        two, three = (flown(tmp_path, fmu, values, rows, way) for fmu in (native_plant, plant))
        assert np.array_equal(two.values, three.values), way
    fmus = (native_plant.with_name("controller-native.fmu"), controller)
    two, three = (
        flown(tmp_path, fmu, {"estimator": "lagged", "x_ref": 0.1}, interface="co-simulation") for fmu in fmus
    )
    assert all(np.array_equal(two[name], three[name]) for name in two.columns)
