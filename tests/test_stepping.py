"""The stepping loop in C: what it calls and when, where it stops and goes on; its rows are the bytes of Python's."""

from __future__ import annotations

import re
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from cosim.blocks.coupling import OWN
from cosim.core.errors import InputError, Interrupted
from cosim.files.results import Results
from cosim.isolation.rows import Rows
from cosim.master.master import StoppedRun, simulate
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.system import build_system
from tests.conftest import ROOT
from tests.deeds import deeds_fmu, deeds_scenario
from tests.lag import lag_fmu
from tests.native import NEEDS_COMPILER, is_subnormal
from tests.typed import TYPED2, numbers_fmu, typed_fmu

pytestmark = NEEDS_COMPILER


# -- whole runs -------------------------------------------------------------------------------------


def both(path: Path, *overrides: str) -> tuple[Results, Results]:
    """A run stepped by C and by Python."""
    made = []
    for in_c in (True, False):
        file = ScenarioFile(path, overrides)
        made.append(simulate(build_system(file), file.scenario.steps, file.scenario.step, in_c=in_c))
    assert (made[0].loop, made[1].loop) == ("C", "Python: asked for")
    return made[0], made[1]


def same(path: Path, *overrides: str) -> Results:
    """The results in C, equal to the last bit to those in Python."""
    in_c, in_python = both(path, *overrides)
    assert in_c.columns == in_python.columns
    assert in_c.values.tobytes() == in_python.values.tobytes()
    assert in_c.time.tobytes() == in_python.time.tobytes()
    assert in_c.notes == in_python.notes
    return in_c


@pytest.mark.parametrize("in_c", [True, False])
def test_sources_have_the_values_of_their_laws(in_c: bool, tmp_path: Path) -> None:
    """A recording on lines and held, a ramp that ends at its target from either side, noise of its variance."""
    (tmp_path / "p.csv").write_text("time,p\n0,1\n0.5,-2\n1.5,0.5\n2.0,4\n")
    lag_fmu(tmp_path / "lag.fmu")
    ramps = [{"at": 0.5, "to": 3, "rate": 2}, {"at": 2, "to": -1, "rate": 4}]
    components = {
        "line": {"block": "playback", "file": "p.csv", "interpolation": "linear"},
        "held": {"block": "playback", "file": "p.csv"},
        "r": {"block": "reference", "signals": {"w": {"start": 1, "changes": ramps}, "z": {"start": 2}}},
        "lag": {"fmu": "lag.fmu"},
    }
    noisy = {"from": "r.z", "to": "lag.u", "noise": {"variance": 0.25, "bias": 0.5}}
    content = {"name": "s", "duration": 40, "step": 0.01, "components": components, "connections": [noisy]}
    (tmp_path / "s.yaml").write_text(yaml.safe_dump(content))
    file, told = ScenarioFile(tmp_path / "s.yaml"), list[int]()
    results = simulate(build_system(file), file.scenario.steps, file.scenario.step, told.append, in_c=in_c)
    assert told == [*range(50, 4001, 50)]
    times, rows, values = results.time, [0, 0.5, 1.5, 2.0], np.array([1, -2, 0.5, 4])
    assert results["line.p"] == pytest.approx(np.interp(times, rows, values), abs=1e-9)
    assert results["held.p"] == pytest.approx(values[np.searchsorted(rows, times + 1e-9, "right") - 1])
    assert results["r.w"] == pytest.approx(np.interp(times, [0.5, 1.5, 2, 3], [1, 3, 3, -1]), abs=1e-9)
    noise = results["lag.u"][1:] - 2.0
    assert (np.mean(noise), np.var(noise)) == pytest.approx((0.5, 0.25), rel=0.1)


def two(folder: Path, **more: Any) -> Path:
    """Two FMUs of C in a circle, a reference and a recording that drive them, noise and every fault on the way."""
    deeds_fmu(folder / "one.fmu", signals=3)
    (folder / "played.csv").write_text("time,p\n0,1\n0.35,-2\n1.0,0.5\n")
    ramps = [{"at": 0.33, "to": 1, "rate": 0.7}, {"at": 1.1, "to": -1}]
    content: dict[str, Any] = {
        "name": "two",
        "duration": 3.0,
        "step": 0.01,
        "start_time": 0.3,
        "seed": 3,
        "components": {
            "r": {"block": "reference", "signals": {"w": {"changes": ramps}, "z": {"start": 2}}},
            "a": {"fmu": "one.fmu"},
            "rec": {"block": "playback", "file": "played.csv"},
            "b": {"fmu": "one.fmu"},
        },
        "connections": [
            {"from": "r.w", "to": "a.u0", "noise": {"variance": 0.01}},
            {"from": "rec.p", "to": "a.u1", "factor": 1.7, "offset": 0.1},
            {"from": "b.y1", "to": "a.u2"},
            {"from": "a.y1", "to": "b.u1", "noise": {"variance": 0.1, "bias": 0.2}, "factor": -0.3},
            {"from": "a.y2", "to": "b.u2"},
        ],
        "faults": [
            {"on": "a.u0", "kind": "dropout", "probability": 0.3, "from": 0.5, "to": 2.5},
            {"on": "a.u2", "kind": "delay", "delay": 0.05, "from": 0.4},
            {"on": "b.u1", "kind": "scale", "value": 3.0, "from": 1.0, "to": 2.0},
            {"on": "b.u1", "kind": "bias", "value": -0.1, "from": 1.5, "to": 2.4},
            {"on": "b.u2", "kind": "spike", "value": 5.0, "probability": 0.1},
        ],
    }
    path = folder / "two.yaml"
    path.write_text(yaml.safe_dump(content | more))
    return path


def test_an_algorithm_of_a_third_party_is_stepped_by_both_loops(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The example of docs/extending.md: each value is of the same time where its source comes later in the order."""
    example = re.search(
        r"```text\n# acme/coupling.py.*?\n(.*?)```", (ROOT / "docs" / "extending.md").read_text("utf-8"), re.DOTALL
    )
    assert example is not None
    names: dict[str, Any] = {"__name__": "acme.coupling"}
    exec(example[1], names)
    path = two(tmp_path, algorithm="reversed", order=["r", "rec", "a", "b"])
    with pytest.raises(InputError, match="algorithm is 'reversed': it should be 'gauss-seidel' or 'jacobi'"):
        build_system(ScenarioFile(path))
    monkeypatch.setattr("cosim.blocks.coupling.OWN", (*OWN, names["REVERSED"]))
    backwards = same(path)
    order = [stage.component.name for stage in build_system(ScenarioFile(path)).stages]
    assert order == ["rec", "r", "b", "a"]  # known signals come first
    assert not np.array_equal(backwards.values, same(two(tmp_path, order=["r", "rec", "a", "b"])).values)


def test_events_and_progress_come_at_their_points(tmp_path: Path) -> None:
    path = two(tmp_path, connections=[], faults=[], components={"a": {"fmu": "one.fmu"}})
    events = "events=[{at: 0.62, set: {a.u1: 3}}, {at: 0.63, set: {a.u1: -1}}, {at: 3.3, set: {a.u2: 5}}]"
    results = same(path, events)
    place = int(np.argmax(results["a.u1"] != 0.0))
    assert (place, results["a.u1"][place : place + 2].tolist(), results["a.u2"][-1]) == (32, [3, -1], 5)
    told: list[int] = []
    file = ScenarioFile(path)
    simulate(build_system(file), 300, 0.01, told.append)
    assert told == [50, 100, 150, 200, 250, 300]


def test_a_foreign_fmu_beside_a_native_one_keeps_its_subnormal_numbers(native_plant: Path, tmp_path: Path) -> None:
    pulse = {"start": 1, "changes": [{"at": 0.02, "to": 0}]}
    lag = {
        "pulse": {"block": "reference", "signals": {"u": pulse}},
        "lag": {"fmu": str(lag_fmu(tmp_path / "lag.fmu")), "start": {"T": 0.04}},
    }
    plant = {"plant": {"fmu": str(native_plant)}}
    found = []
    for components in (lag, plant | lag):
        content = {"name": "halved", "duration": 22, "step": 0.02, "order": [*components], "components": components}
        content["connections"] = [{"from": "pulse.u", "to": "lag.u", "factor": 3.0}]
        (tmp_path / "halved.yaml").write_text(yaml.safe_dump(content))
        found.append(same(tmp_path / "halved.yaml")["lag.y"])
    assert is_subnormal(found[0]).sum() > 50
    assert found[0].tobytes() == found[1].tobytes()


def test_the_rows_of_fmi_3_are_the_same_bytes_up_to_the_end_it_asks_for(tmp_path: Path) -> None:
    fmu = str(numbers_fmu(tmp_path))
    ramp = {"start": 0.25, "changes": [{"at": 0.3, "to": 1.25, "rate": 1}]}
    for last, rows in ((7, 11), (250, 9), (251, 9)):
        counts = {"start": 0, "changes": [{"at": 0.35, "to": 200}, {"at": 0.7, "to": last}]}
        content = {
            "name": "three",
            "duration": 1,
            "step": 0.1,
            "components": {"r": {"block": "reference", "signals": {"u": ramp, "n": counts}}, "a": {"fmu": fmu}},
            "connections": [{"from": "r.u", "to": "a.a[1,2]"}, {"from": "r.n", "to": "a.byte"}],
        }
        path = tmp_path / "three.yaml"
        path.write_text(yaml.safe_dump(content))
        in_c, in_python = stopped(path)
        assert in_c == in_python
        results = both(path)[0]
        assert len(results.time) == rows
        assert results["a.byte_out"][5] == 200
        assert results.time[-1] == {7: 1.0, 250: 0.8, 251: 0.75}[last]


def without_text(text: str) -> dict[str, str]:
    """What leaves text out of the description of `typed_fmu`."""
    found = re.findall(r'    <ScalarVariable name="s_(?:in|out)".*?</ScalarVariable>\n', text, re.S)
    return {**dict.fromkeys(found, ""), '<Unknown index="19" dependencies="18"/>': ""}


def test_integers_booleans_and_enumerations_are_the_same_bytes(tmp_path: Path) -> None:
    fmu = typed_fmu(tmp_path, **without_text(TYPED2))
    ramp = {"start": 0, "changes": [{"at": 0, "to": 1, "rate": 1}]}
    steps = {"start": 0, "changes": [{"at": 0.3, "to": 1}, {"at": 0.5, "to": 0}, {"at": 0.8, "to": 1}]}
    gears = {"start": 1, "changes": [{"at": 0.4, "to": 2}, {"at": 0.6, "to": 1}]}
    content = {
        "name": "typed",
        "duration": 1,
        "step": 0.1,
        "components": {
            "r": {"block": "reference", "signals": {"u": ramp, "b": steps, "e": gears}},
            "a": {"fmu": str(fmu)},
            "c": {"fmu": str(fmu)},
        },
        "connections": [
            {"from": "r.u", "to": "a.r_in"},
            {"from": "r.b", "to": "a.b_in"},
            {"from": "r.e", "to": "a.e_in"},
            {"from": "a.b_out", "to": "c.i_in"},
            {"from": "a.e_out", "to": "c.e_in"},
            {"from": "a.b_out", "to": "c.b_in"},
        ],
    }
    path = tmp_path / "typed.yaml"
    path.write_text(yaml.safe_dump(content))
    results = same(path)
    assert results["c.e_out"].tolist() == [1, 1, 1, 1, 2, 2, 1, 1, 1, 1, 1]
    for wrong, words in (
        ({"e": {**gears, "changes": [{"at": 0.4, "to": 3}]}}, "a.e_in at t = 0.4 s: 3, which comes from r.e, is none"),
        ({"b": {**steps, "changes": [{"at": 0.4, "to": 2}]}}, "a.b_in at t = 0.4 s: the input 2 is outside 0 … 1"),
    ):
        content["components"]["r"]["signals"] |= {"u": ramp, "b": steps, "e": gears} | wrong  # type: ignore[index]
        path.write_text(yaml.safe_dump(content))
        (in_c, _, _), (in_python, _, _) = stopped(path)
        assert in_c == in_python
        assert words in in_c


def stopped(path: Path) -> list[tuple[str, bytes, list[str]]]:
    """Of a run in C and in Python: how it ended, its rows, and what its FMUs said."""
    found = []
    for in_c in (True, False):
        file = ScenarioFile(path)
        system = build_system(file)
        try:
            results = simulate(system, file.scenario.steps, file.scenario.step, in_c=in_c)
            how = " ".join(results.notes)
        except StoppedRun as end:
            results, how = end.results, f"{type(end.error).__name__} {end.error}"
        assert results.loop == ("C" if in_c else "Python: asked for")
        said = [text for stage in system.stages for text in getattr(stage.component, "log", ())]
        found.append((how, results.time.tobytes() + results.values.tobytes(), said))
    return found


@pytest.mark.parametrize("call", ["SetReal", "DoStep", "GetReal"])
@pytest.mark.parametrize("deed", ["warning", "discard", "end", "error", "fatal", "nan"])
def test_what_an_fmu_does_is_told_in_the_same_words_with_the_same_rows(tmp_path: Path, call: str, deed: str) -> None:
    at = {"SetReal": 9, "DoStep": 5, "GetReal": 9}[call]
    in_c, in_python = stopped(deeds_scenario(tmp_path, call, deed, at))
    assert in_c == in_python
    assert (in_c[0] == "") == (deed == "warning")
    if deed == "warning":
        assert any(f"fmi2{call} returned Warning" in text for text in in_c[2])


def test_an_end_that_one_fmu_alone_asks_for_leaves_a_row_of_that_time(tmp_path: Path) -> None:
    deeds_fmu(tmp_path / "one.fmu", "DoStep", "end", 4)
    content = {"name": "end", "duration": 1, "step": 0.1, "components": {"a": {"fmu": "one.fmu"}}}
    (tmp_path / "end.yaml").write_text(yaml.safe_dump(content))
    in_c, in_python = stopped(tmp_path / "end.yaml")
    assert in_c == in_python
    assert "ended the simulation" in in_c[0]


@pytest.mark.skipif(sys.platform == "win32", reason="has no such signal")
@pytest.mark.parametrize("deed", ["slow", "warning"])
def test_ctrl_c_in_process_is_seen_within_seconds_and_leaves_the_rows(tmp_path: Path, deed: str) -> None:
    file = ScenarioFile(deeds_scenario(tmp_path, "DoStep", deed, at=0, duration=1e6 if deed == "warning" else 100.0))
    system, steps = build_system(file), file.scenario.steps
    rows = Rows(
        np.zeros((steps + 1, len(system.columns))), tell_loop=lambda _: signal.setitimer(signal.ITIMER_REAL, 0.1)
    )
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    try:
        with pytest.raises(StoppedRun) as stopped:
            simulate(system, steps, 0.1, rows=rows)
    finally:
        signal.signal(signal.SIGALRM, before)
    assert isinstance(stopped.value.error, Interrupted)
    assert stopped.value.results.loop == "C"
    assert 1 < len(stopped.value.results.time) < steps
