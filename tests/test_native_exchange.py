"""Native plants in the hands of a solver: the same derivatives, and an event for all that is discrete."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu

from cosim.fmi.building.build import build_native
from cosim.model import SCALAR
from plant.hovercraft import Hovercraft
from tests.cases import some
from tests.native import NEEDS_COMPILER, Exchange, dop853, rk4
from tests.test_effects import CASES, EVERYTHING, MEMORY, MOVING, named
from tests.test_native import STEP, TIGHT, by_fmu, difference, wandering

pytestmark = NEEDS_COMPILER
REMEMBERING = ("actuator_delay", "servo_backlash")
SMOOTH = {name: value for name, value in EVERYTHING.items() if name not in REMEMBERING}
STARTS = {f"{name}_start": v for name, v in (MOVING | MEMORY).items()}
OUTPUTS = [q.name for q in Hovercraft.outputs]
HOVER = list(Hovercraft().start_command())


def solved(fmu: Path, rows: Any, values: dict[str, Any], solve: Any) -> Any:
    """Outputs after each row, held for a step, by a solver outside that stops at events."""
    exchange = Exchange(fmu, values)
    due = exchange.begin(rows[0])
    x, found = exchange.x, []
    for k, row in enumerate(rows):
        t, end = k * STEP, (k + 1) * STEP
        due = exchange.event(t, row)
        while due is not None and due < end:
            x = solve(exchange.rates, t, x, due)
            t, due = due, exchange.event(due, row)
        x = solve(exchange.rates, t, x, end)
        exchange.rates(end, x)
        exchange.fmu.completedIntegratorStep()
        found.append(exchange.read(end, x))
    exchange.finish()
    return np.array(found)


def plants_own(f: Any, t: float, x: Any, end: float) -> Any:
    return rk4(f, t, x, end - t, max(1, math.ceil((end - t) / Hovercraft.substep - 1e-6)))


@pytest.mark.parametrize(
    ("effects", "near"),
    [
        (SMOOTH, TIGHT),
        *some([({}, TIGHT), *((case, TIGHT) for case, _ in CASES if not set(case) & set(REMEMBERING))], every=4),
        # What remembers is updated at events. Whole substeps of delay: nothing is blurred by the mean over a substep.
        ({"actuator_delay": {"time": 0.06}}, 1e-9),
        ({"servo_backlash": {"width": 0.05}}, 1e-9),
    ],
    ids=str,
)  # fmt: skip
def test_the_plants_own_substeps_driven_from_outside_are_its_co_simulation(
    effects: Any, near: float, native_plant: Path
) -> None:
    rows, values = wandering(Hovercraft(), 100), named(effects) | STARTS
    assert difference(by_fmu(native_plant, rows, values, STEP), solved(native_plant, rows, values, plants_own)) < near


def python_rates(values: dict[str, float]) -> Any:
    """The Python equations as a solver sees them: f(t, x, command that acts), and the state at the start."""
    model = Hovercraft().with_values({n: v for n, v in values.items() if not n.endswith("_start")})
    derivative, output = model.acting(SCALAR)
    starts = {n.removesuffix("_start"): v for n, v in values.items() if n.endswith("_start")}
    return derivative, output, np.array(model.start(starts))


@pytest.mark.parametrize(
    "effects", [{}, SMOOTH, {"actuator_delay": {"time": 0.0337}, "servo_backlash": {"width": 0.05}}]
)
def test_a_fine_solver_that_stops_at_events_finds_what_it_finds_on_the_python_equations(
    effects: Any, native_plant: Path
) -> None:
    rows, values = wandering(Hovercraft(), 25), named(effects) | STARTS
    found = solved(native_plant, rows, values, dop853)
    memoryless = {n: v for n, v in values.items() if not n.startswith(REMEMBERING)}
    derivative, output, x = python_rates(memoryless)
    late = effects.get("actuator_delay", {}).get("time", 0.0)
    half = 0.5 * effects.get("servo_backlash", {}).get("width", -1.0)
    # delay and play by their equations, command by command: (time from which it acts, command)
    arriving = [(-math.inf, tuple(MEMORY[f"actuator_delay.{q.name}"] for q in Hovercraft.inputs))] if late else []
    arriving += [(k * STEP + late, row) for k, row in enumerate(rows)]
    play, acting = [MEMORY["servo_backlash.play_right"], MEMORY["servo_backlash.play_left"]], []
    for since, row in arriving:
        if half > 0.0:
            play = [min(max(p, a - half), a + half) for p, a in zip(play, row[2:], strict=True)]
            row = (*row[:2], *play)
        acting.append((since, row))
    model = Hovercraft().with_values({n: v for n, v in memoryless.items() if not n.endswith("_start")})
    from cosim.model import Stepper

    stepper = Stepper(model)
    expected, t = [], 0.0
    for k, row in enumerate(rows):
        end = (k + 1) * STEP
        stops = [s for s, _ in acting if k * STEP + 1e-12 < s < end - 1e-12]
        for stop in (*stops, end):
            command = [c for s, c in acting if s <= t + 1e-12][-1]
            command, _ = stepper.shape(t, STEP, command, tuple(() for _ in stepper.shaping))
            x = dop853(lambda s, y, u=command: np.array(derivative(s, tuple(y), u)), t, x, stop)  # type: ignore[misc]
            t = stop
        expected.append(output(end, tuple(x), row))
    assert difference(np.array(expected), found) < 1e-8


def test_a_solver_of_another_host_meets_a_delay_of_whole_input_intervals(native_plant: Path) -> None:
    values = {"actuator_delay.time": 0.04}
    rows = wandering(Hovercraft(), 20)
    names = [q.name for q in Hovercraft.inputs]
    held = np.zeros(2 * len(rows), dtype=[("time", float), *((name, float) for name in names)])
    held["time"] = np.repeat(np.arange(len(rows) + 1) * STEP, 2)[1:-1]
    for name, column in zip(names, np.array(rows).T, strict=True):
        held[name] = np.repeat(column, 2)
    common = {"start_values": values, "input": held, "stop_time": len(rows) * STEP, "output_interval": STEP}
    run = fmpy.simulate_fmu(
        str(native_plant), fmi_type="ModelExchange", solver="CVode", relative_tolerance=1e-8, output=OUTPUTS, **common
    )
    exact = by_fmu(native_plant, rows, values, STEP)[-1]
    assert np.array([run[name][-1] for name in OUTPUTS]) == pytest.approx(exact, abs=1e-4)


def test_moving_inputs_are_refused_where_something_remembers_and_taken_elsewhere(native_plant: Path) -> None:
    for values, refused in (({}, False), ({"actuator_delay.time": 0.05}, True), ({"servo_backlash.width": 0.05}, True)):
        exchange = Exchange(native_plant, values)
        exchange.begin(HOVER)
        exchange.rates(0.01, exchange.x)
        exchange.fmu.setReal(exchange.inputs[2:3], [0.01])  # in continuous-time mode
        exchange.rates(0.015, exchange.x)  # what a solver only tries is not judged
        if not refused:
            exchange.fmu.completedIntegratorStep()
            exchange.finish()
            continue
        with pytest.raises(FMICallException):
            exchange.fmu.completedIntegratorStep()
        exchange.fmu.freeInstance()


def test_a_late_command_is_an_event_of_its_own(native_plant: Path) -> None:
    exchange = Exchange(native_plant, {"actuator_delay.time": 0.3})
    assert exchange.begin(HOVER) is None
    assert exchange.event(1.0, [*HOVER[:2], 0.1, 0.0]) == 1.0 + 0.3
    assert exchange.event(1.2, [*HOVER[:2], 0.2, 0.0]) == 1.0 + 0.3
    tilting = 12
    assert exchange.rates(1.25, exchange.x)[tilting] == 0.0
    assert exchange.event(1.0 + 0.3, [*HOVER[:2], 0.2, 0.0]) == 1.2 + 0.3
    assert exchange.rates(1.31, exchange.x)[tilting] == pytest.approx(0.1 / 0.0884)
    exchange.fmu.completedIntegratorStep()
    assert exchange.event(1.2 + 0.3, [*HOVER[:2], 0.2, 0.0]) is None
    exchange.finish()


def test_an_indicator_stands_still_while_its_effect_sleeps_and_crosses_where_it_has_its_kink(
    native_plant: Path,
) -> None:
    def crossing(values: dict[str, float], before: list[float], after: list[float]) -> int:
        """Indicators with another sign at another command."""
        exchange = Exchange(native_plant, values)
        exchange.begin(before)
        first = exchange.indicators()
        exchange.event(0.0, after)
        second = exchange.indicators()
        exchange.finish()
        return int(np.sum(np.sign(first) != np.sign(second)))

    tilted = [*HOVER[:2], 0.1, 0.1]
    assert crossing({}, HOVER, tilted) == 0
    assert crossing({"servo_dead_band.width": 0.05}, HOVER, tilted) == 2  # both servos leave the band
    assert crossing({"servo_rate_limit.rate": 0.5}, HOVER, tilted) == 2
    assert crossing({}, HOVER, [0.0, HOVER[1], 0.0, 0.0]) == 1  # below zero thrust
    exchange = Exchange(native_plant, {})
    exchange.begin(HOVER)
    still, x = exchange.indicators(), exchange.x
    x[8] = -0.5  # rolled so far that one propeller is as low as R/2
    exchange.rates(0.0, x)
    assert int(np.sum(np.sign(still) != np.sign(exchange.indicators()))) == 1
    exchange.finish()


def test_directional_derivatives_are_differences_of_the_equations(native_plant: Path) -> None:
    rng = np.random.default_rng(3)
    exchange = Exchange(native_plant, named(SMOOTH) | STARTS)
    u = np.array([*HOVER[:2], 0.13, -0.11])
    exchange.begin(list(u))
    x = exchange.x + 0.01 * rng.normal(size=exchange.states)
    states = [exchange.place[f"{name}_state"] for name in MOVING] + [
        exchange.place[f"actuator_second_order.tilt_rate_{side}_state"] for side in ("right", "left")
    ]
    rates = [vr + exchange.states for vr in states]
    change = rng.normal(size=exchange.states + 4)

    def values(size: float) -> Any:
        exchange.fmu.setReal(exchange.inputs, list(u + size * change[-4:]))
        dx = exchange.rates(0.3, x + size * change[:-4])
        return np.concatenate((dx, exchange.fmu.getReal(exchange.outputs)))

    expected = (values(1e-6) - values(-1e-6)) / 2e-6
    values(0.0)
    knowns, unknowns = [*states, *exchange.inputs], [*rates, *exchange.outputs]
    found = np.array(exchange.fmu.getDirectionalDerivative(unknowns, knowns, list(change)))
    assert np.allclose(found, expected, rtol=1e-6, atol=1e-6)
    assert np.count_nonzero(found) > 20
    exchange.finish()


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
    from tests.tank import MODEL
    from tests.test_native import by_python

    text = MODEL.replace("\n\n@dataclass(frozen=True, kw_only=True)\nclass Tank(Model):", COUNTING)
    (tmp_path / "tank.py").write_text(text.replace("(Leak, Draw)", "(Slow, Leak, Draw)"), encoding="utf-8")
    (built,) = build_native(tmp_path, f"{tmp_path}/tank.py:Tank")
    from cosim.fmi.building.file import load_model

    model, rows = load_model(f"{tmp_path}/tank.py:Tank", Path()).model, [(0.02 + 0.01 * (k % 9),) for k in range(60)]
    exact = by_python(model, rows, {"slow.time": 4.0}, 0.5)
    assert difference(exact, by_fmu(built.path, rows, {"slow.time": 4.0}, 0.5)) < TIGHT
    Exchange(built.path, {}).begin([0.03])
    exchange = Exchange(built.path, {"slow.time": 4.0})
    with pytest.raises(FMICallException):
        exchange.begin([0.03])
    assert "slow counts substeps" in exchange.log[-1]


@pytest.mark.thorough
def test_fmi_3_says_the_same(native_plant: Path, tmp_path: Path) -> None:
    plant, controller = build_native(tmp_path, "hovercraft", fmi=3)
    assert [p.path.name for p in (plant, controller)] == ["plant-native-fmi3.fmu", "controller-native-fmi3.fmu"]
    assert validate_fmu(str(plant.path)) == validate_fmu(str(controller.path)) == []
    signal = np.array([(0, 0.1), (0.2, 0.1), (0.2, -0.1), (0.4, -0.1)], dtype=[("time", "f8"), ("tilt_right", "f8")])
    constant = {"duty_right": HOVER[0], "duty_left": HOVER[1], "tilt_left": 0.0}
    start = named(SMOOTH) | {"actuator_delay.time": 0.06, "roll_ground_effect": False} | constant
    common: dict[str, Any] = {"stop_time": 0.4, "input": signal, "start_values": start, "output_interval": STEP}
    for way, more in (
        ("CoSimulation", {"step_size": STEP}),
        ("ModelExchange", {"solver": "CVode", "relative_tolerance": 1e-8}),
    ):
        runs = [fmpy.simulate_fmu(str(fmu), fmi_type=way, **more, **common) for fmu in (native_plant, plant.path)]
        assert runs[0].dtype.names == runs[1].dtype.names
        for name in runs[0].dtype.names:
            assert list(runs[0][name]) == list(runs[1][name]), (way, name)
    flown = [
        fmpy.simulate_fmu(
            str(fmu), stop_time=0.5, step_size=STEP, output_interval=STEP, start_values={"estimator": "lagged"}
        )
        for fmu in (native_plant.parent / "controller-native.fmu", controller.path)
    ]
    assert [list(row) for row in flown[0]] == [list(row) for row in flown[1]]
