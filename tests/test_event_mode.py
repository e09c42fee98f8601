"""Event mode, early return, clocks and scheduled execution of FMI 3.0, by FMUs that refuse what FMI forbids."""

from __future__ import annotations

import json
import math
import runpy
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.blocks.compiling import compiling
from cosim.blocks.event_mode import EventFmu
from cosim.core.errors import InputError
from cosim.files.results import Results
from cosim.master.master import StoppedRun, simulate
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.workflow import run
from cosim.system.system import System, build_system
from tests.bounce1 import bounce_fmu
from tests.conftest import ROOT
from tests.decay import DEEDS, decay_fmu
from tests.instants import CONSTANT, instants_fmu, library
from tests.slider import slider_fmu

EXAMPLE = ROOT / "examples" / "clocks"
RISES = {"fmu": "plain.fmu", "event_mode": True, "start": {"u": 3.0}}  # reaches level 1 at 1/3, 2/3 and 1 s


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place: Path = tmp_path_factory.mktemp("instants")
    instants_fmu(place / "plain.fmu")
    instants_fmu(place / "states.fmu", states=True)
    instants_fmu(place / "updates.fmu", updates=True)
    instants_fmu(place / "rigid.fmu", steps=False)
    instants_fmu(place / "clocked.fmu", CONSTANT)
    instants_fmu(place / "clocked_states.fmu", CONSTANT, states=True)
    instants_fmu(place / "rigid_clocked.fmu", CONSTANT, steps=False)
    instants_fmu(place / "scheduled.fmu", CONSTANT, scheduled=True)
    slider_fmu(place / "slider.fmu")
    return place


def scenario(folder: Path, components: dict[str, Any], connections: Sequence[str] = (), **more: Any) -> ScenarioFile:
    wires = [dict(zip(("from", "to"), text.split(" → "), strict=True)) for text in connections]
    content = {"name": "s", "duration": 1, "step": 0.1, "components": components, "connections": wires} | more
    path = folder / "s.yaml"
    path.write_text(json.dumps(content))
    return ScenarioFile(path)


def system_of(folder: Path, *arguments: Any, **more: Any) -> System:
    return build_system(scenario(folder, *arguments, **more))


def simulated(folder: Path, *arguments: Any, **more: Any) -> Results:
    file = scenario(folder, *arguments, **more)
    return simulate(build_system(file), file.scenario.steps, file.scenario.step)


def messages_of(folder: Path, *arguments: Any, **more: Any) -> list[str]:
    with pytest.raises(InputError) as refused:
        system_of(folder, *arguments, **more)
    return [fault.message for fault in refused.value.faults]


# -- events ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "declared",
    [
        'intervalDecimal="0"',
        'intervalDecimal="-1"',
        'intervalDecimal="abc"',
        'intervalCounter="1" resolution="0"',
    ],
)
def test_a_clock_without_a_period_is_a_fault_of_its_fmu(tmp_path: Path, declared: str) -> None:
    instants_fmu(tmp_path / "bad.fmu", f'intervalVariability="constant" {declared}')
    with pytest.raises(InputError) as failure:
        build_system(scenario(tmp_path, {"a": {"fmu": "bad.fmu"}}))
    assert failure.value.exit_code == 3


def test_an_event_of_one_fmu_reaches_the_others_at_its_own_time(folder: Path) -> None:
    follower = {"fmu": "states.fmu", "event_mode": True, "start": {"level": 9.0}}
    results = simulated(folder, {"b": follower, "a": RISES}, ["a.events → b.kick"])
    assert results.loop == "Python: event mode"
    assert results["a.at"][[4, 7, 10]] == pytest.approx([1 / 3, 2 / 3, 1], abs=1e-9)
    assert results["b.at"] == pytest.approx(results["a.at"], abs=1e-12)
    assert results["b.x"].tolist() == [0] * 4 + [1] * 3 + [3] * 3 + [6]  # 1 + 2 + 3, added in event mode
    assert results.event_counts == {"a": {"event": 3}, "b": {"input": 3}}
    assert [cause for _, _, cause in results.events] == ["event", "input"] * 3
    assert not results.notes


def test_errors_of_location_do_not_add_up_over_chained_events(folder: Path) -> None:
    """140 events that each begin where the last one ended, and a bouncing ball within its solver's tolerance."""
    bounce_fmu(folder / "ball.fmu")
    ball = {"fmu": "ball.fmu", "solver": "cvode", "tolerance": 1e-11}
    rises = {"fmu": "states.fmu", "event_mode": True, "start": {"u": 7.0}}
    chained = simulated(folder, {"a": rises}, duration=20)
    results = simulated(folder, {"a": rises, "ball": ball}, duration=2)  # before the end of its bounces, at 2.56 s
    times = [t for t, name, cause in chained.events if (name, cause) == ("a", "event")]
    assert times == pytest.approx([k / 7.0 for k in range(1, 141)], abs=1e-12)
    fall, restitution, gravity = math.sqrt(2.0 / 9.81), 0.7, 9.81
    speed = gravity * fall
    bounces = [fall]
    for k in range(3):
        bounces.append(bounces[-1] + 2.0 * speed * restitution ** (k + 1) / gravity)
    assert [t for t, name, _ in results.events if name == "ball"][:4] == pytest.approx(bounces, abs=1e-9)


def test_intermediate_updates_bound_the_lead_of_fmus_that_cannot_go_back(folder: Path) -> None:
    components = {
        name: {"fmu": "updates.fmu", "event_mode": True, "start": {"u": u, "own_step": 0.004}}
        for name, u in (("a", 3.0), ("b", 7.0))
    }
    results = simulated(folder, components, record=["*.returns"])
    assert results["a.returns"][-1] + results["b.returns"][-1] > 200  # 250 own steps
    leads = [float(note.split(" up to ")[1].split(" s ")[0]) for note in results.notes]
    assert max(leads, default=0.0) <= 0.004 + 1e-12
    assert results["a.at"][-1] == pytest.approx(1.0, abs=1e-9)


def test_fmus_of_other_kinds_are_stepped_to_the_events(folder: Path) -> None:
    slider_fmu(folder / "exchange.fmu", exchange=True)
    components = {
        "a": RISES,
        "m": {"fmu": "exchange.fmu", "start": {"gain": 1.0, "damping": 1.0}, "tolerance": 1e-8},
        "s": {"fmu": "slider.fmu", "start": {"gain": 1.0, "damping": 1.0}},
    }
    results = simulated(folder, components, ["a.events → m.force", "a.events → s.force"], algorithm="jacobi")
    exact = sum(np.where(results.time > at, 1 - np.exp(-(results.time - at)), 0) for at in (1 / 3, 2 / 3))
    assert results["m.velocity"] == pytest.approx(exact, abs=1e-6)  # tolerance of the solver
    assert results["s.velocity"] == pytest.approx(exact, abs=1e-4)  # its midpoint rule


def test_an_event_of_model_exchange_reaches_the_others_at_its_own_time(folder: Path) -> None:
    """y = exp(−t) crosses 0.8, and a time event at 0.15 s, while another FMU returns early at 1/7 s and so on."""
    decay_fmu(folder / "decay.fmu")
    decay = {"fmu": "decay.fmu", "start": {"deed": DEEDS.index("due at once")}, "tolerance": 1e-8}
    components = {
        "a": {"fmu": "states.fmu", "event_mode": True, "start": {"u": 7.0}},
        "m": decay,
        "b": {"fmu": "states.fmu", "event_mode": True, "start": {"level": 99.0}},
    }
    alone = simulated(folder, {"m": decay})
    results = simulated(folder, components, ["m.events → b.u"])
    assert results["m.events"].tolist() == alone["m.events"].tolist()
    assert results["m.y"] == pytest.approx(alone["m.y"], abs=1e-7)
    crossing, due = (next(t for t, *c in results.events if c == ["m", f"{w} event"]) for w in ("state", "time"))
    assert crossing == pytest.approx(-math.log(0.8), abs=1e-6)  # as exact as the solver
    assert due == pytest.approx(0.15, abs=1e-12)
    kicked = [t for t, *cause in results.events if cause == ["b", "input"]]
    assert kicked[-2:] == [due, crossing]
    assert not results.notes


def test_a_component_with_steps_of_one_length_is_named_and_gets_events_at_the_end_of_its_step(folder: Path) -> None:
    components = {"a": RISES, "r": {"fmu": "rigid.fmu", "event_mode": True, "start": {"u": 0.5}}}
    file = scenario(folder, components, ["a.events → r.kick"])
    system = build_system(file)
    assert any("r takes only steps of one length" in warning for warning in system.warnings)
    results = simulate(system, file.scenario.steps, file.scenario.step)
    assert results["a.at"][4] == pytest.approx(1 / 3, abs=1e-9)
    assert results["r.at"][4] == pytest.approx(0.4)


def test_events_of_the_scenario_act_in_event_mode(folder: Path) -> None:
    events = [{"at": 0.2, "set": {"a.kick": 3}}, {"at": 0, "set": {"a.kick": 1}}]
    results = simulated(folder, {"a": RISES | {"start": {}}}, events=events)
    assert results["a.x"].tolist() == [1] * 2 + [4] * 9
    assert results["a.kick"].tolist() == [1] * 2 + [3] * 9


def test_a_loop_of_discrete_values_settles_in_superdense_time(folder: Path) -> None:
    loop = RISES | {"start": {"plus": 1, "most": 5, "u": 0.0}}
    results = simulated(folder, {"a": loop, "b": loop}, ["a.echo → b.kick", "b.echo → a.kick"], algorithm="jacobi")
    assert results["a.kick"].tolist() == results["b.kick"].tolist() == [5] * 11


def test_a_loop_without_an_end_is_refused_with_fmu_variable_and_time(folder: Path) -> None:
    grows = RISES | {"start": {"u": 3.0, "plus": 0}}
    first = {"a": grows, "b": RISES | {"start": {"u": 0.0, "plus": 1}}, "c": RISES | {"start": {"u": 0.0}}}
    wires = ["a.events → c.kick", "c.echo → b.kick"]
    assert simulated(folder, first, wires)["b.echo"][-1] == 4
    chatters = {"a": RISES | {"start": {"u": 1.0, "floor": 1.0 - 1e-13}}}
    with pytest.raises(StoppedRun, match=r"^a at t = 1 s: 1000 events within 1e-07 s") as stopped:
        simulated(folder, chatters, duration=2)
    assert len(stopped.value.results.time) == 11


# -- clocks -----------------------------------------------------------------------------------------


def test_a_clock_reads_and_writes_its_variables_at_its_ticks(folder: Path) -> None:
    results = simulated(folder, {"a": RISES, "b": {"fmu": "clocked.fmu"}}, ["a.x → b.w"])
    ticks = np.arange(1, 12)
    assert results["b.sample"].tolist() == results["b.ticks"].tolist() == ticks.tolist()
    # At 1 s the clock ticks before the event that lets x fall from 1 to 0.
    assert results["b.y"] == pytest.approx([*(results["a.x"] + ticks)[:-1], 1 + 11])
    assert results.whole >= {"b.sample", "b.crossed"}


def test_an_output_clock_ticks_the_clocks_connected_to_it_and_starts_a_countdown(folder: Path) -> None:
    source = {"fmu": "clocked.fmu", "start": {"u": 3.0}}
    target = {"fmu": "clocked_states.fmu", "start": {"delay": 0.125}}
    results = simulated(folder, {"b": target, "a": source}, ["a.crossed → b.trigger"])
    assert results["b.triggered"].tolist() == [0] * 4 + [1] * 3 + [2] * 3 + [3]
    assert results["b.rung"][[5, 8]] == pytest.approx([1 / 3 + 0.125, 2 / 3 + 0.125], abs=1e-9)
    assert results["b.alarm"][-1] == 2


@pytest.mark.parametrize(
    ("sample", "settings", "ticks"),
    [
        (CONSTANT, {}, 11),
        ('intervalVariability="constant" intervalCounter="1" shiftCounter="1" resolution="4"', {}, 4),
        ('intervalVariability="fixed" intervalDecimal="0.1"', {}, 11),
        ('intervalVariability="fixed" intervalDecimal="0.1"', {"interval": 0.25}, 5),
        ('intervalVariability="fixed"', {}, 10),  # the FMU says 0.1 s, from 0.05 s on
        ('intervalVariability="tunable"', {}, 4),  # 0.05 s and then 0.2, 0.4, 0.8 s
        ('intervalVariability="changing"', {}, 4),  # 0.1 s and then 0.2, 0.4, 0.8 s later
        ('intervalVariability="triggered"', {"at": [0, 0.31, 0.99]}, 3),
        ('intervalVariability="triggered"', {"interval": 0.3, "shift": 0.2}, 3),
    ],
)
def test_clocks_tick_at_the_times_that_their_kind_gives(
    tmp_path: Path, sample: str, settings: dict[str, Any], ticks: int
) -> None:
    instants_fmu(tmp_path / "a.fmu", sample)
    clocks = {"clocks": {"sample": settings}} if settings else {}
    results = simulated(tmp_path, {"a": {"fmu": "a.fmu", **clocks}})
    expected = {'intervalVariability="tunable"': 3, 'intervalVariability="changing"': 3}.get(sample, ticks)
    assert results["a.ticks"][-1] == results["a.sample"][-1] == expected


def test_a_clock_faster_than_the_steps_of_its_fmu_is_refused(folder: Path) -> None:
    with pytest.raises(
        StoppedRun, match=r"r.sample at t = 0\.2 s: the clock ticks every 0\.1 s, but its FMU takes only"
    ):
        simulated(folder, {"r": {"fmu": "rigid_clocked.fmu"}}, step=0.2)


def test_an_event_of_the_scenario_changes_the_interval_of_a_tunable_clock(tmp_path: Path) -> None:
    instants_fmu(tmp_path / "a.fmu", 'intervalVariability="tunable" intervalDecimal="0.1"')
    events = [{"at": 0.2, "set": {"a.sample": "250 ms"}}]
    results = simulated(tmp_path, {"a": {"fmu": "a.fmu"}}, events=events)
    assert results["a.ticks"].tolist() == [1, 2, 3, 3, 3, 4, 4, 5, 5, 5, 6]  # at 0.45, 0.7, 0.95 s
    assert results["a.rung"][-1] == 0.25  # told to the FMU
    for name, value in (("a.sample", -1), ("a.sample", "fast"), ("a.sample", True), ("a.trigger", 1)):
        assert messages_of(tmp_path, {"a": {"fmu": "a.fmu"}}, events=[{"at": 0.2, "set": {name: value}}])


def test_an_interruption_ends_a_long_step_at_the_next_step_of_the_fmu(folder: Path) -> None:
    fmu = system_of(folder, {"a": {"fmu": "updates.fmu", "event_mode": True, "start": {"own_step": 0.01}}})
    block = fmu.stages[0].component
    assert isinstance(block, EventFmu)
    block.bind_nothing()
    block.open(0.0, 1.0)
    block.start()
    block.update()
    block.leave()
    block.instance.stop = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        block.go(1.0)
    assert block.instance.last.value == pytest.approx(0.01)
    block.close()


# -- scheduled execution ------------------------------------------------------------------------------


def test_partitions_run_in_the_order_of_their_priorities(folder: Path) -> None:
    clocks = {"trigger": {"at": [0.2]}}
    results = simulated(folder, {"a": {"fmu": "scheduled.fmu", "clocks": clocks, "start": {"delay": 0.0, "gain": 2.0}}})
    assert results["a.ticks"].tolist() == list(range(1, 12))
    assert results["a.order"][3] == 112311  # at 0.2 s the trigger (priority 1), its alarm (0), then the sample (2)
    assert results["a.rung"][-1] == pytest.approx(0.2)
    assert results["a.y"].tolist() == list(range(1, 12))


def test_scheduled_partitions_exchange_values_and_clocks_with_other_fmus(folder: Path) -> None:
    partition = {"fmu": "scheduled.fmu", "start": {"u": 2.5, "delay": 0.05}}  # counts a crossing at 0.4 and 0.8 s
    components = {"p": partition, "a": RISES, "b": {"fmu": "clocked.fmu"}}
    wires = ["a.x → p.w", "p.crossed → b.trigger", "b.crossed → p.trigger", "p.events → b.kick"]
    results = simulated(folder, components, wires)
    assert results["p.y"][:-1] == pytest.approx((results["a.x"] + np.arange(1, 12))[:-1])
    assert results["b.triggered"].tolist() == [0] * 4 + [1] * 4 + [2] * 3
    assert results["b.x"].tolist() == [0] * 4 + [1] * 4 + [3] * 3


# -- whole runs and mistakes ----------------------------------------------------------------------------


def test_a_run_in_a_worker_tells_its_events_in_the_manifest(folder: Path, tmp_path: Path) -> None:
    components = {"a": RISES, "b": {"fmu": "clocked.fmu"}}
    file = scenario(folder, components, ["a.x → b.w"])
    outcome = run(file.path, tmp_path / "out", report=False)
    here = simulate(build_system(file), file.scenario.steps, file.scenario.step)
    assert np.array_equal(outcome.results.values, here.values)
    record = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert record["loop"] == "Python: event mode"
    assert record["event_counts"]["b"] == {"clock sample": 11, **record["event_counts"]["b"]}
    assert record["first_events"][0][0] == 0.0


@pytest.mark.parametrize(
    ("component", "connections"),
    [
        ({"fmu": "clocked.fmu", "event_mode": False, "clocks": {"sample": {"interval": 1}}}, ()),
        ({"fmu": "plain.fmu", "clocks": {"sample": {"interval": 1}}}, ()),
        (
            {"fmu": "clocked.fmu", "clocks": {"trigge": {"at": [1]}}},
            (),
        ),
        ({"fmu": "clocked.fmu", "clocks": {"crossed": {"at": [1]}}}, ()),
        ({"fmu": "clocked.fmu", "clocks": {"sample": {"interval": 1}}}, ()),
        ({"fmu": "clocked.fmu", "clocks": {"alarm": {"at": [1]}}}, ()),
        ({"fmu": "clocked.fmu", "clocks": {"trigger": {}}}, ()),
        ({"fmu": "clocked.fmu", "clocks": {"trigger": {"at": [1, 0.5]}}}, ()),
        ({"fmu": "clocked.fmu", "clocks": {"trigger": {"at": [1]}}}, ("b.crossed → b.trigger",)),
        ({"fmu": "clocked.fmu"}, ("b.x → b.trigger",)),
        ({"fmu": "clocked.fmu", "start": {"sample": 1}}, ()),
        ({"fmu": "slider.fmu", "event_mode": True}, ()),  # of FMI 2.0
    ],
)
def test_mistakes_with_clocks_are_answered(folder: Path, component: dict[str, Any], connections: Sequence[str]) -> None:
    assert messages_of(folder, {"b": component}, connections)


# -- the example ----------------------------------------------------------------------------------------


def test_the_example_of_a_clocked_tank_follows_its_equations(tmp_path: Path) -> None:
    library()  # skips the test without a compiler
    runpy.run_path(str(EXAMPLE / "build.py"))["build"](tmp_path)
    shutil.copy(EXAMPLE / "tank.yaml", tmp_path)
    with compiling(True):
        outcome = run(tmp_path / "tank.yaml", tmp_path / "out")
    results, manifest = outcome.results, outcome.manifest
    assert all(criterion["met"] for criterion in manifest["criteria"])
    events = manifest["first_events"]
    over, resumed = (next(t for t, *cause in events if cause == c) for c in (["tank", "clock over"], RESUMES))
    assert over == pytest.approx(first_crossing(), abs=1e-9)
    assert resumed == pytest.approx(over + 30.0, abs=1e-9)
    assert results["monitor.alarmed"][-1] == over
    assert results["tank.P"][[116, 145]].tolist() == [0.0, 0.0]
    assert results["tank.P"][150] > 0.0


RESUMES = ["controller", "clock resume"]


def first_crossing() -> float:
    """Return the time [s] at which the tank of the example first rises through 60 °C, by its equations."""
    temperature, integral, t = 20.0, 0.0, 0.0
    while True:
        error = 58.0 - temperature
        wanted = 100.0 * (error + integral / 30.0)
        power = min(max(wanted, 0.0), 2000.0)
        integral += 5.0 * error if power == wanted else 0.0
        final = 20.0 + power / 20.0
        at = 200.0 * math.log((final - temperature) / (final - 60.0)) if final > 60.0 else math.inf
        if at <= 5.0:
            return t + at
        temperature, t = final + (temperature - final) * math.exp(-5.0 / 200.0), t + 5.0
