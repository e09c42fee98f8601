"""Event mode, early return, clocks and scheduled execution of FMI 3.0, by FMUs that refuse what FMI forbids."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.core.errors import InputError
from cosim.files.results import Results
from cosim.master.master import StoppedRun, simulate
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.workflow import run
from cosim.system.system import build_system
from tests.conftest import ROOT
from tests.decay import DEEDS, decay_fmu
from tests.instants import CONSTANT, instants_fmu
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


def simulated(folder: Path, *arguments: Any, **more: Any) -> Results:
    file = scenario(folder, *arguments, **more)
    return simulate(build_system(file), file.scenario.steps, file.scenario.step)


# -- events ---------------------------------------------------------------------------------------


def test_an_event_of_one_fmu_reaches_the_others_at_its_own_time(folder: Path, tmp_path: Path) -> None:
    follower = {"fmu": "states.fmu", "event_mode": True, "start": {"level": 9.0}}
    file = scenario(folder, {"b": follower, "a": RISES}, ["a.events → b.kick"])
    results = simulate(build_system(file), file.scenario.steps, file.scenario.step)
    assert results["a.at"][[4, 7, 10]] == pytest.approx([1 / 3, 2 / 3, 1], abs=1e-9)
    assert results["b.at"] == pytest.approx(results["a.at"], abs=1e-12)
    assert results["b.x"].tolist() == [0] * 4 + [1] * 3 + [3] * 3 + [6]  # 1 + 2 + 3, added in event mode
    assert results.event_counts == {"a": {"event": 3}, "b": {"input": 3}}
    assert [cause for _, _, cause in results.events] == ["event", "input"] * 3
    assert not results.notes
    outcome = run(file.path, tmp_path / "out", report=False)  # in a worker
    assert np.array_equal(outcome.results.values, results.values)
    record = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert record["event_counts"] == results.event_counts
    assert record["first_events"][0][0] == pytest.approx(1 / 3, abs=1e-9)


def test_errors_of_location_do_not_add_up_over_chained_events(folder: Path) -> None:
    """140 events that each begin where the last one ended."""
    chained = simulated(folder, {"a": RISES | {"fmu": "states.fmu", "start": {"u": 7.0}}}, duration=20)
    assert [t for t, *_ in chained.events] == pytest.approx([k / 7.0 for k in range(1, 141)], abs=1e-12)


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
    start = {"gain": 1.0, "damping": 1.0}
    components = {
        "a": RISES,
        "m": {"fmu": "exchange.fmu", "start": start, "tolerance": 1e-8},
        "s": {"fmu": "slider.fmu", "start": start},
    }
    results = simulated(folder, components, ["a.events → m.force", "a.events → s.force"], algorithm="jacobi")
    exact = sum(np.where(results.time > at, 1 - np.exp(-(results.time - at)), 0) for at in (1 / 3, 2 / 3))
    assert results["m.velocity"] == pytest.approx(exact, abs=1e-6)  # tolerance of the solver
    assert results["s.velocity"] == pytest.approx(exact, abs=1e-4)  # its midpoint rule


def test_an_event_of_model_exchange_reaches_the_others_at_its_own_time(folder: Path) -> None:
    """y = exp(−t) crosses 0.8, and a time event at 0.15 s, while another FMU returns early at 1/7 s and so on."""
    decay_fmu(folder / "decay.fmu")
    decay = {"fmu": "decay.fmu", "start": {"deed": DEEDS.index("due at once")}, "tolerance": 1e-8}
    states = RISES | {"fmu": "states.fmu"}
    components = {"a": states | {"start": {"u": 7.0}}, "m": decay, "b": states | {"start": {"level": 99.0}}}
    results = simulated(folder, components, ["m.events → b.u"])
    assert results["m.y"] == pytest.approx(np.exp(-results.time), abs=1e-6)
    due, crossing = [t for t, *cause in results.events if cause == ["b", "input"]][-2:]
    assert crossing == pytest.approx(-math.log(0.8), abs=1e-6)  # as exact as the solver
    assert due == pytest.approx(0.15, abs=1e-12)


def test_a_component_with_steps_of_one_length_gets_events_at_the_end_of_its_step(folder: Path) -> None:
    components = {"a": RISES, "r": {"fmu": "rigid.fmu", "event_mode": True, "start": {"u": 0.5}}}
    results = simulated(folder, components, ["a.events → r.kick"])
    assert results["a.at"][4] == pytest.approx(1 / 3, abs=1e-9)
    assert results["r.at"][4] == pytest.approx(0.4)
    with pytest.raises(StoppedRun, match=r"r.sample at t = 0\.2 s"):  # a clock is faster than they are
        simulated(folder, {"r": {"fmu": "rigid_clocked.fmu"}}, step=0.2)


def test_a_loop_of_discrete_values_settles_and_one_without_an_end_is_refused(folder: Path) -> None:
    loop = RISES | {"start": {"plus": 1, "most": 5, "u": 0.0}}
    results = simulated(folder, {"a": loop, "b": loop}, ["a.echo → b.kick", "b.echo → a.kick"], algorithm="jacobi")
    assert results["a.kick"].tolist() == results["b.kick"].tolist() == [5] * 11
    chatters = {"a": RISES | {"start": {"u": 1.0, "floor": 1.0 - 1e-13}}}
    with pytest.raises(StoppedRun, match=r"^a at t = 1 s: 1000 events") as stopped:
        simulated(folder, chatters, duration=2)
    assert len(stopped.value.results.time) == 11


# -- clocks -----------------------------------------------------------------------------------------


def test_clocks_tick_each_other_and_their_variables_are_read_and_written_then(folder: Path) -> None:
    source = {"fmu": "clocked.fmu", "start": {"u": 3.0}}
    target = {"fmu": "clocked_states.fmu", "start": {"delay": 0.125}}
    wires = ["a.x → b.w", "b.crossed → c.trigger"]
    results = simulated(folder, {"c": target, "a": RISES, "b": source}, wires)
    ticks = np.arange(1, 12)
    assert results["b.sample"].tolist() == results["b.ticks"].tolist() == ticks.tolist()
    assert results["b.y"][:-1] == pytest.approx((results["a.x"] + ticks)[:-1])
    assert results["c.triggered"].tolist() == [0] * 4 + [1] * 3 + [2] * 3 + [3]
    assert results["c.rung"][[5, 8]] == pytest.approx([1 / 3 + 0.125, 2 / 3 + 0.125], abs=1e-9)  # a countdown
    assert results["c.alarm"][-1] == 2


@pytest.mark.parametrize(
    ("kind", "settings", "ticks"),
    [
        ('constant" intervalCounter="1" shiftCounter="1" resolution="4', {}, 4),
        ('fixed" intervalDecimal="0.1', {"interval": 0.25}, 5),
        ("fixed", {}, 10),  # the FMU says 0.1 s, from 0.05 s on
        ("tunable", {}, 3),  # 0.05 s and then 0.2, 0.4 s
        ("changing", {}, 3),  # 0.1 s and then 0.2, 0.4 s later
        ("triggered", {"at": [0, 0.31, 0.99]}, 3),
        ("triggered", {"interval": 0.3, "shift": 0.2}, 3),
    ],
)
def test_clocks_tick_at_the_times_that_their_kind_gives(
    tmp_path: Path, kind: str, settings: dict[str, Any], ticks: int
) -> None:
    instants_fmu(tmp_path / "a.fmu", f'intervalVariability="{kind}"')
    clocks = {"clocks": {"sample": settings}} if settings else {}
    results = simulated(tmp_path, {"a": {"fmu": "a.fmu", **clocks}})
    assert results["a.ticks"][-1] == results["a.sample"][-1] == ticks


def test_an_event_of_the_scenario_changes_the_interval_of_a_tunable_clock(tmp_path: Path) -> None:
    instants_fmu(tmp_path / "a.fmu", 'intervalVariability="tunable" intervalDecimal="0.1"')
    events = [{"at": 0.2, "set": {"a.sample": "250 ms"}}]
    results = simulated(tmp_path, {"a": {"fmu": "a.fmu"}}, events=events)
    assert results["a.ticks"].tolist() == [1, 2, 3, 3, 3, 4, 4, 5, 5, 5, 6]  # at 0.45, 0.7, 0.95 s
    assert results["a.rung"][-1] == 0.25  # told to the FMU
    for name, value in (("a.sample", -1), ("a.sample", "fast"), ("a.trigger", 1)):
        with pytest.raises(InputError):
            simulated(tmp_path, {"a": {"fmu": "a.fmu"}}, events=[{"at": 0.2, "set": {name: value}}])


# -- scheduled execution ------------------------------------------------------------------------------


def test_partitions_run_in_the_order_of_their_priorities(folder: Path) -> None:
    clocks = {"trigger": {"at": [0.2]}}
    results = simulated(folder, {"a": {"fmu": "scheduled.fmu", "clocks": clocks, "start": {"delay": 0.0, "gain": 2.0}}})
    assert results["a.ticks"].tolist() == list(range(1, 12))
    assert results["a.order"][3] == 112311  # at 0.2 s the trigger (priority 1), its alarm (0), then the sample (2)
    assert results["a.rung"][-1] == pytest.approx(0.2)


def test_scheduled_partitions_exchange_values_and_clocks_with_other_fmus(folder: Path) -> None:
    partition = {"fmu": "scheduled.fmu", "start": {"u": 2.5, "delay": 0.05}}  # counts a crossing at 0.4 and 0.8 s
    components = {"p": partition, "a": RISES, "b": {"fmu": "clocked.fmu"}}
    wires = ["a.x → p.w", "p.crossed → b.trigger", "b.crossed → p.trigger", "p.events → b.kick"]
    results = simulated(folder, components, wires)
    assert results["p.y"][:-1] == pytest.approx((results["a.x"] + np.arange(1, 12))[:-1])
    assert results["b.triggered"].tolist() == [0] * 4 + [1] * 4 + [2] * 3
    assert results["b.x"].tolist() == [0] * 4 + [1] * 4 + [3] * 3


# -- mistakes -------------------------------------------------------------------------------------------


def test_mistakes_with_clocks_are_answered(folder: Path) -> None:
    mistakes: list[tuple[dict[str, Any], list[str]]] = [
        ({"clocks": {"sample": {"interval": 1}}, "event_mode": False}, []),
        ({"clocks": {"trigge": {"at": [1]}}}, []),
        ({"clocks": {"crossed": {"at": [1]}}}, []),  # an output
        ({"clocks": {"sample": {"interval": 1}}}, []),  # a constant
        ({"clocks": {"trigger": {"at": [1, 0.5]}}}, []),
        ({"clocks": {"trigger": {"at": [1]}}}, ["b.crossed → b.trigger"]),
        ({}, ["b.x → b.trigger"]),
        ({"start": {"sample": 1}}, []),
        ({"event_mode": True, "fmu": "slider.fmu"}, []),  # of FMI 2.0
    ]
    for component, wires in mistakes:
        with pytest.raises(InputError) as refused:
            simulated(folder, {"b": {"fmu": "clocked.fmu"} | component}, wires)
        assert refused.value.exit_code == 2, component


def test_a_clock_without_a_period_is_a_fault_of_its_fmu(tmp_path: Path) -> None:
    instants_fmu(tmp_path / "bad.fmu", 'intervalVariability="constant" intervalCounter="1" resolution="0"')
    with pytest.raises(InputError) as failure:
        simulated(tmp_path, {"a": {"fmu": "bad.fmu"}})
    assert failure.value.exit_code == 3
