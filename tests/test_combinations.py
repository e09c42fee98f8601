"""Processes of their own, algebraic loops, controlled steps and event mode in one run (table in docs/coupling.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosim.core.errors import InputError
from cosim.files.results import Results
from cosim.isolation.limits import Limits
from cosim.master.master import simulate
from cosim.master.own_process import in_own_processes
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.system import build_system
from tests.coupled import CHASSIS, LINEAR, TRUCK, WHEEL, coupled_fmu
from tests.instants import CONSTANT, instants_fmu
from tests.test_event_mode import RISES, scenario

TICKS = {"fmu": "clocked.fmu", "start": {"level": 9.0}}
LOOP = ("a.y0 → b.u0", "b.y0 → a.u0")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place: Path = tmp_path_factory.mktemp("combinations")
    instants_fmu(place / "plain.fmu")
    instants_fmu(place / "states.fmu", states=True)
    instants_fmu(place / "clocked.fmu", CONSTANT)
    instants_fmu(place / "scheduled.fmu", CONSTANT, scheduled=True)
    coupled_fmu(place / "linear.fmu", LINEAR, slopes=True)
    coupled_fmu(place / "exchange.fmu", LINEAR, exchange=True)
    coupled_fmu(place / "chassis.fmu", CHASSIS)
    coupled_fmu(place / "wheel.fmu", WHEEL)
    return place


def ran(file: ScenarioFile, apart: Sequence[str] = ()) -> Results:
    system = replace(build_system(file), apart=frozenset(apart))
    return simulate(in_own_processes(system, Limits()), file.scenario.steps, file.scenario.step)


def check_equal(one: Results, other: Results) -> None:
    assert one.columns == other.columns
    assert one.values.tobytes() == other.values.tobytes()
    assert (one.events, one.event_counts) == (other.events, other.event_counts)
    assert one.details == other.details


# -- processes of their own ---------------------------------------------------------------------------


def test_fmus_with_event_mode_in_processes_of_their_own_have_the_same_bytes(folder: Path) -> None:
    components = {
        "a": RISES,
        "b": {"fmu": "states.fmu", "event_mode": True, "start": {"u": 7.0}},  # goes back to the events of a
        "c": TICKS,
        "s": {"fmu": "scheduled.fmu"},
    }
    wires = ["a.events → b.kick", "b.x → c.u", "c.y → s.w", "b.x → c.w", "c.crossed → s.trigger"]
    file = scenario(folder, components, wires, events=[{"at": 0.5, "set": {"c.gain": 2.0}}])
    here = ran(file)
    assert here.event_counts["a"]["event"] == 3
    assert {"event", "input"} <= here.event_counts["b"].keys()
    assert here.event_counts["s"]["clock sample"] == 11
    check_equal(ran(file, components), here)


def test_states_are_taken_back_in_a_process_of_its_own(folder: Path) -> None:
    components = {n: {"fmu": f"{n}.fmu", "start": TRUCK[k]} for n, k in (("chassis", CHASSIS), ("wheel", WHEEL))}
    wires = ("chassis.y0 → wheel.u0", "wheel.y0 → chassis.u0")
    step = {"max": 0.02, "min": 1e-4, "tolerance": 1e-3}
    file = scenario(folder, components | {"wheel": components["wheel"] | {"process": "own"}}, wires, duration=0.1)
    file = scenario(folder, components, wires, duration=1.12, step=step)
    here = ran(file)
    assert here.details["steps"]["estimator"] == "halving"
    assert here.details["steps"]["rejected"] > 0
    check_equal(ran(file, ["wheel"]), here)


def test_steps_of_a_loop_are_repeated_in_a_process_of_its_own(folder: Path) -> None:
    components = {
        "a": {"fmu": "linear.fmu", "start": {"p0": 5.0, "p1": 1.0, "late": 1.0}},
        "b": {"fmu": "linear.fmu", "start": {"p0": 1.0}},
    }
    file = scenario(folder, components, LOOP, duration=0.5)
    here = ran(file)
    assert here.details["loops"][0]["repeated"] == ["a"]
    assert here.details["loops"][0]["derivatives"]["b"] == "directional"
    assert here["a.y0"][1:] == pytest.approx(-0.25, rel=1e-7)
    check_equal(ran(file, ["a", "b"]), here)


# -- event mode with loops and controlled steps ---------------------------------------------------------


def test_a_loop_is_solved_beside_fmus_in_event_mode(folder: Path) -> None:
    components = {
        "a": {"fmu": "linear.fmu", "start": {"p0": 0.5, "p1": 1.0, "p2": 1.0, "p3": 1.0}},
        "b": {"fmu": "linear.fmu", "start": {"p0": -2.0}},
    }
    alone = ran(scenario(folder, components, LOOP))
    file = scenario(folder, components | {"c": TICKS, "r": RISES}, LOOP)
    beside = ran(file)
    assert beside.loop == "Python: event mode"
    assert beside.details["loops"] == alone.details["loops"]
    assert beside.event_counts["r"]["event"] == 3
    for name in alone.columns:
        assert beside[name].tobytes() == alone[name].tobytes(), name
    reasons = [text for text in build_system(file).warnings if " is part of the algebraic loop " in text]
    assert [w.partition(" is part of the algebraic loop ")[0] for w in reasons] == ["a", "b"]
    check_equal(ran(file, ["a", "c"]), beside)


def test_loops_through_event_mode_or_model_exchange_beside_it_are_refused(folder: Path) -> None:
    linear = {"fmu": "linear.fmu", "start": {"p0": -0.5}}
    events = {"fmu": "plain.fmu", "event_mode": True}
    for other, wires in (
        ({"fmu": "exchange.fmu"}, LOOP),
        (events, ("a.y0 → b.u", "b.x → a.u0")),
    ):
        more = {"loops": {}} if other is events else {}
        with pytest.raises(InputError) as refused:
            build_system(scenario(folder, {"a": linear, "b": other, "c": TICKS}, wires, **more))
        assert refused.value.exit_code == 2


def test_steps_are_controlled_between_events(folder: Path) -> None:
    components = {n: {"fmu": f"{n}.fmu", "start": TRUCK[k]} for n, k in (("chassis", CHASSIS), ("wheel", WHEEL))}
    wires = ("chassis.y0 → wheel.u0", "wheel.y0 → chassis.u0")
    equal = ran(scenario(folder, components, wires, duration=2, step=1e-4, record=["chassis.y0", "wheel.y0"]))
    step = {"max": 0.02, "min": 1e-4, "rows": 0.1, "tolerance": 1e-2}
    file = scenario(folder, components | {"r": RISES, "c": TICKS}, wires, duration=2, step=step)
    results = ran(file)
    steps = results.details["steps"]
    assert steps["estimator"] == "residual"
    assert steps["sizes"]["100 %"] > 10 * steps["sizes"]["0 %"]
    assert steps["accepted"] < 0.2 * 20_000
    for name in ("chassis.y0", "wheel.y0"):
        scale = np.abs(equal[name]).max()
        assert np.abs(results[name] - equal[name][::1000]).max() < 0.05 * scale, name
    assert [t for t, *cause in results.events if cause == ["r", "event"]] == pytest.approx(
        [k / 3 for k in range(1, 7)], abs=1e-9
    )
    assert results["c.ticks"][-1] == 21
    check_equal(ran(file, ["wheel", "r"]), results)


def test_halving_and_courses_are_refused_with_event_mode(folder: Path) -> None:
    step = {"max": 0.02, "min": 1e-4, "tolerance": 1e-2}
    for more in ({"step": step | {"estimator": "halving"}}, {"extrapolate": "linear"}):
        with pytest.raises(InputError) as refused:
            build_system(scenario(folder, {"r": RISES}, (), **more))
        assert len(refused.value.faults) == 1
