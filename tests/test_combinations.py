"""Processes of their own, algebraic loops, controlled steps and event mode in one run (table in docs/coupling.md).

Random systems have the same rows whatever steps them: C, Python, or the policy of events.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest

import cosim
from cosim.core.arrays import Array
from cosim.core.errors import InputError
from cosim.files.results import Results
from cosim.isolation.limits import Limits
from cosim.master.master import simulate
from cosim.master.own_process import in_own_processes
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.system import build_system
from tests.coupled import LINEAR, coupled_fmu, truck
from tests.instants import CONSTANT, instants_fmu
from tests.test_event_mode import RISES, scenario
from tests.walker import walker_fmu

TICKS = {"fmu": "clocked.fmu", "start": {"level": 9.0}}
LOOP = ("a.y0 → b.u0", "b.y0 → a.u0")


def linear(a: dict[str, float], b: dict[str, float]) -> dict[str, Any]:
    return {name: {"fmu": "linear.fmu", "start": start} for name, start in (("a", a), ("b", b))}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place: Path = tmp_path_factory.mktemp("combinations")
    instants_fmu(place / "plain.fmu")
    instants_fmu(place / "states.fmu", states=True)
    for version in ("2", "3"):
        walker_fmu(place / f"saving{version}.fmu", saves=True, version=version)
    walker_fmu(place / "direct2.fmu", saves=False)
    walker_fmu(place / "text.fmu", saves=True, mood=True)
    instants_fmu(place / "clocked.fmu", CONSTANT)
    coupled_fmu(place / "linear.fmu", LINEAR, slopes=True)
    rows = "".join(f"{k / 7},{(k * k) % 11},{k % 3}\n" for k in range(40))
    (place / "recording.csv").write_text(f"time,w,v\n{rows}")
    instants_fmu(place / "scheduled.fmu", CONSTANT, scheduled=True)
    coupled_fmu(place / "exchange.fmu", LINEAR, exchange=True)
    return place


def ran(file: ScenarioFile, apart: Sequence[str] = ()) -> Results:
    system = replace(build_system(file), apart=frozenset(apart))
    return simulate(in_own_processes(system, Limits()), file.scenario.steps, file.scenario.step)


def check_apart(file: ScenarioFile, apart: Sequence[str], here: Results) -> None:
    """Check that a run with components in processes of their own has the same bytes."""
    there = ran(file, apart)
    assert there.values.tobytes() == here.values.tobytes()
    assert (there.columns, there.events, there.event_counts) == (here.columns, here.events, here.event_counts)
    assert there.details == here.details


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
    check_apart(file, [*components], here)


def test_states_are_taken_back_in_a_process_of_its_own(folder: Path) -> None:
    file = scenario(folder, *truck(folder), duration=1.12, step={"max": 0.02, "min": 1e-4, "tolerance": 1e-3})
    here = ran(file)
    assert here.details["steps"]["estimator"] == "halving"
    assert here.details["steps"]["rejected"] > 0
    check_apart(file, ["wheel"], here)


def test_steps_of_a_loop_are_repeated_in_a_process_of_its_own(folder: Path) -> None:
    file = scenario(folder, linear({"p0": 5.0, "p1": 1.0, "late": 1.0}, {"p0": 1.0}), LOOP, duration=0.5)
    here = ran(file)
    assert here.details["loops"][0]["repeated"] == ["a"]
    assert here.details["loops"][0]["derivatives"]["b"] == "directional"
    assert here["a.y0"][1:] == pytest.approx(-0.25, rel=1e-7)
    check_apart(file, ["a", "b"], here)


# -- event mode with loops and controlled steps ---------------------------------------------------------


def test_what_does_not_go_with_event_mode_is_refused(folder: Path) -> None:
    one, events = {"fmu": "linear.fmu", "start": {"p0": -0.5}}, {"fmu": "plain.fmu", "event_mode": True}
    step = {"max": 0.02, "min": 1e-4, "tolerance": 1e-2, "estimator": "halving"}
    for components, wires, more in (
        ({"a": one, "b": {"fmu": "exchange.fmu"}}, LOOP, {}),  # a loop through model exchange
        ({"a": one, "b": events}, ("a.y0 → b.u", "b.x → a.u0"), {"loops": {}}),  # or through event mode
        ({"r": RISES}, (), {"step": step}),
        ({"r": RISES}, (), {"extrapolate": "linear"}),
    ):
        with pytest.raises(InputError) as refused:
            build_system(scenario(folder, components | {"c": TICKS}, wires, **more))
        assert refused.value.exit_code == 2


def test_steps_are_controlled_between_events(folder: Path) -> None:
    components, wires = truck(folder)
    equal = ran(scenario(folder, components, wires, duration=2, step=1e-4, record=["chassis.y0", "wheel.y0"]))
    step = {"max": 0.02, "min": 1e-4, "rows": 0.1, "tolerance": 1e-2}
    file = scenario(folder, components | {"r": RISES, "c": TICKS}, wires, duration=2, step=step)
    results = ran(file)
    steps = results.details["steps"]
    assert steps["estimator"] == "residual"
    assert steps["sizes"]["100 %"] > 10 * steps["sizes"]["0 %"]
    assert steps["accepted"] < 0.2 * 20_000
    for name in ("chassis.y0", "wheel.y0"):
        assert np.abs(results[name] - equal[name][::1000]).max() < 0.05 * np.abs(equal[name]).max(), name
    crossings = [t for t, *cause in results.events if cause == ["r", "event"]]
    assert crossings == pytest.approx([k / 3 for k in range(1, 7)], abs=1e-9)
    assert results["c.ticks"][-1] == 21
    check_apart(file, ["wheel", "r"], results)


# -- random systems, whatever steps them -----------------------------------------------------------

STEP = 0.01
ASKED = "Python: asked for"
FAULTS: tuple[dict[str, Any], ...] = (
    {"kind": "delay", "delay": 0.03},
    {"kind": "dropout", "probability": 0.4},
    {"kind": "freeze", "from": 0.1, "to": 0.3},
    {"kind": "bias", "value": 0.25, "from": 0.2},
    {"kind": "scale", "value": -0.5},
    {"kind": "spike", "value": 2.0, "probability": 0.1},
    {"kind": "stuck", "value": 0.3, "from": 0.25, "to": 0.31},
)


def random_system(random: Random) -> dict[str, Any]:
    """Return the scenario of a random system; FMUs with direct feedthrough follow each other in one direction."""
    kinds = {f"c{k}": random.choice(("saving2", "saving3", "direct2")) for k in range(random.randint(2, 5))}
    names = [*kinds]
    components: dict[str, Any] = {}
    for name, kind in kinds.items():
        components[name] = {"fmu": f"{kind}.fmu", "start": {"gain": round(random.uniform(0.2, 1.5), 3)}}
        if random.random() < 0.3:
            components[name]["step"] = random.choice((1, 2, 3, 4)) * STEP
    components["known"] = {
        "block": "reference",
        "signals": {"r": {"start": 0, "changes": [{"at": 0.105, "to": 1}, {"at": 0.2, "to": 0, "rate": 2}]}},
    }
    components["recorded"] = {"block": "playback", "file": "recording.csv"}
    connections: list[dict[str, Any]] = []
    for k, (name, kind) in enumerate(kinds.items()):
        others = names[:k] if kind == "direct2" else [other for other in names if other != name]
        source = random.choice([f"{other}.y" for other in others] + ["known.r", "recorded.w", "recorded.v"])
        connections.append({"from": source, "to": f"{name}.u"})
        if random.random() < 0.4:
            connections[-1]["noise"] = {"variance": 0.01, "bias": round(random.uniform(-0.1, 0.1), 3)}
        if random.random() < 0.2:
            connections[-1]["factor"] = round(random.uniform(-2, 2), 3)
    targets = [f"{name}.u" for name in names if "step" not in components[name]]
    faults = random.sample(FAULTS, random.randint(0, 3)) if targets else []
    return {
        "name": "random",
        "duration": 0.48,
        "step": STEP,
        "seed": random.randint(1, 1000),
        "algorithm": random.choice(("gauss-seidel", "gauss-seidel", "jacobi")),
        "components": components,
        "connections": connections,
        "faults": [{"on": random.choice(targets), **fault} for fault in faults],
        "events": [
            {"at": round(random.uniform(0.0, 0.48), 3), "set": {f"{random.choice(names)}.gain": 0.7}}
            for _ in range(random.randint(0, 2))
        ],
    }


def beside(system: dict[str, Any], fmu: str) -> dict[str, Any]:
    """Return a system with an FMU that has no connections but takes another loop: by event mode, or that has a text."""
    return system | {"components": system["components"] | {"aside": {"fmu": fmu}}}


def rows(folder: Path, system: dict[str, Any], loop: str, columns: Sequence[str] = ()) -> tuple[Sequence[str], Array]:
    """Return columns and rows of a run, after a check of what stepped it."""
    path = folder / "system.json"
    path.write_text(json.dumps(system))
    if loop == ASKED:
        file = ScenarioFile(path)
        results = simulate(build_system(file), file.scenario.steps, file.scenario.step, in_c=False)
    else:
        results = cosim.run(path, in_process=True).results
    assert results.loop.startswith(loop)
    columns = columns or results.columns
    return columns, results.values[:, [results.columns.index(name) for name in columns]]


def check_loops(folder: Path, system: dict[str, Any], loop: str) -> None:
    """Check that a loop, that of Python and the policy of events have the same numbers."""
    columns, first = rows(folder, system, loop)
    _, in_python = rows(folder, system, ASKED, columns)
    assert in_python.tobytes() == first.tobytes()
    _, at_events = rows(folder, beside(system, "clocked.fmu"), "Python: event mode", columns)
    assert at_events == pytest.approx(first, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("seed", range(16))
def test_c_and_python_give_the_same_bytes_and_events_the_same_numbers(folder: Path, seed: int) -> None:
    system = random_system(Random(seed))
    check_loops(folder, system, "C")
    columns, in_c = rows(folder, system, "C")
    _, beside_text = rows(folder, beside(system, "text.fmu"), "C", columns)
    assert beside_text.tobytes() == in_c.tobytes()


@pytest.mark.parametrize("seed", range(16, 24))
def test_blocks_that_only_python_steps_and_loops_have_the_same_numbers_from_event_to_event(
    folder: Path, seed: int
) -> None:
    random = Random(seed)
    system = random_system(random) | {"algorithm": "gauss-seidel"}
    system["components"] |= {
        "fix": {"block": "fix", "rate": 12, "latency": 0.02, "signals": {"y": {"noise": {"variance": 0.1}}}},
        "a": {"fmu": "linear.fmu", "start": {"p0": random.uniform(-2, 0.5), "p1": 1.0}},
        "b": {"fmu": "linear.fmu", "start": {"p0": random.uniform(-2, 0.5)}},
    }
    system["connections"] += [
        {"from": "c0.y", "to": "fix.y"},
        {"from": "a.y0", "to": "b.u0"},
        {"from": "b.y0", "to": "a.u0"},
    ]
    check_loops(folder, system, "C, but in Python: ")


@pytest.mark.parametrize("seed", range(24, 30))
@pytest.mark.parametrize("extrapolate", ["hold", "linear", "quadratic"])
@pytest.mark.parametrize("interpolate", ["hold", "linear"])
def test_controlled_steps_of_the_length_of_equal_ones_have_the_same_numbers(
    folder: Path, seed: int, extrapolate: str, interpolate: str
) -> None:
    system = random_system(Random(seed)) | {"extrapolate": extrapolate, "interpolate": interpolate}
    for component in system["components"].values():
        component.pop("step", None)
    step = {"max": 0.01, "min": 0.01, "rows": 0.01, "tolerance": 1.0, "estimator": "residual"}
    columns, equal = rows(folder, system, "")
    _, controlled = rows(folder, system | {"step": step}, "Python: steps are controlled", columns)
    assert controlled == pytest.approx(equal, rel=1e-12, abs=1e-12)
