"""The stepping loop in C: what it calls and when, where it stops and goes on; its rows are the bytes of Python's."""

from __future__ import annotations

import re
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.blocks.coupling import OWN_ALGORITHMS, Algorithm, Plan
from cosim.core.errors import InputError, Interrupted
from cosim.files.results import Results
from cosim.isolation.rows import Rows
from cosim.master.master import StoppedRun, simulate
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.system import build_system
from tests.conftest import ROOT
from tests.coupled import truck
from tests.deeds import deeds_fmu, deeds_scenario
from tests.known.kit import Model
from tests.lag import lag_fmu
from tests.native import NEEDS_COMPILER, is_subnormal
from tests.test_event_mode import scenario
from tests.typed import typed_fmu, typed_text

pytestmark = NEEDS_COMPILER


def reference(**changes: Any) -> dict[str, Any]:
    """Return a block of signals that start at 0, from their changes (time, value, rate if any)."""
    keys = ("at", "to", "rate")
    signals = {n: {"changes": [dict(zip(keys, change, strict=False)) for change in c]} for n, c in changes.items()}
    return {"block": "reference", "signals": signals}


def stopped(file: ScenarioFile) -> tuple[str, Results, list[str]]:
    """How a run ended, its results and what its FMUs said: stepped by C, and equal to the last bit in Python."""
    found = []
    for in_c in (True, False):
        system = build_system(file)
        try:
            results = simulate(system, file.scenario.steps, file.scenario.step, in_c=in_c)
            how = " ".join(results.notes)
        except StoppedRun as end:
            results, how = end.results, f"{type(end.error).__name__} {end.error}"
        assert results.loop == ("C" if in_c else "Python: asked for")
        said = [text for stage in system.stages for text in getattr(stage.component, "log", ())]
        found.append((how, results.columns, results.time.tobytes(), results.values.tobytes(), results.exact, said))
    assert found[0] == found[1]
    return how, results, said


def both(file: ScenarioFile) -> list[Results]:
    """Return the results of the loop in C and in Python."""
    return [simulate(build_system(file), file.scenario.steps, file.scenario.step, in_c=in_c) for in_c in (True, False)]


def same(folder: Path, *content: Any, **more: Any) -> Results:
    how, results, _ = stopped(scenario(folder, *content, **more))
    assert how == ""
    return results


def test_an_algorithm_of_a_third_party_is_stepped_by_both_loops(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The example of docs/extending.md: each value is of the same time where its source comes later in the order."""
    text = (ROOT / "docs" / "extending.md").read_text("utf-8")
    (example,) = re.findall(r"```text\n# acme/coupling.py.*?\n(.*?)```", text, re.DOTALL)
    names: dict[str, Any] = {"__name__": "acme.coupling"}
    exec(example, names)
    deeds_fmu(tmp_path / "one.fmu", signals=3)
    components = {"r": reference(w=[(0.3, 1, 0.7)]), "a": {"fmu": "one.fmu"}, "b": {"fmu": "one.fmu"}}
    wires, order = ["r.w → a.u0", "a.y1 → b.u1", "b.y1 → a.u2"], ["r", "a", "b"]
    usual = same(tmp_path, components, wires, order=order)
    monkeypatch.setattr("cosim.blocks.coupling.OWN_ALGORITHMS", (*OWN_ALGORITHMS, names["REVERSED"]))
    backwards = scenario(tmp_path, components, wires, order=order, algorithm="reversed")
    assert not np.array_equal(stopped(backwards)[1].values, usual.values)
    assert [stage.component.name for stage in build_system(backwards).stages] == ["r", "b", "a"]
    third = type("Third", (Algorithm,), {"name": "third", "plan": lambda *given: Plan(("a",), (False,) * 3)})
    monkeypatch.setattr("cosim.blocks.coupling.OWN_ALGORITHMS", (*OWN_ALGORITHMS, third()))
    with pytest.raises(InputError, match="third steps a; "):
        build_system(scenario(tmp_path, components, wires, algorithm="third"))


def test_a_foreign_fmu_beside_a_native_one_keeps_its_subnormal_numbers(native_plant: Path, tmp_path: Path) -> None:
    lag_fmu(tmp_path / "lag.fmu")
    lag = {"pulse": reference(u=[(0, 3), (0.02, 0)]), "lag": {"fmu": "lag.fmu", "start": {"T": 0.04}}}
    found = []
    for components in (lag, {"plant": {"fmu": str(native_plant)}} | lag):
        results = same(tmp_path, components, ["pulse.u → lag.u"], duration=22, step=0.02, order=[*components])
        found.append(results["lag.y"])
    assert is_subnormal(found[0]).sum() > 50
    assert found[0].tobytes() == found[1].tobytes()


@pytest.mark.parametrize(
    ("booleans", "items", "told"),
    [
        ([(0.3, 1), (0.5, 0), (0.8, 1)], [(0.4, 2), (0.6, 1)], ""),
        ([(0.3, 1)], [(0.4, 3)], "a.e_in at t = 0.4 s: 3 from r.e"),
        ([(0.4, 2)], [], "a.b_in at t = 0.4 s: the input 2 is outside 0 … 1"),
    ],
)
def test_integers_booleans_and_enumerations_are_the_same_bytes(
    tmp_path: Path, booleans: Any, items: Any, told: str
) -> None:
    text = re.findall(r'<ScalarVariable name="s_(?:in|out)".*', typed_text())
    fmu = {"fmu": typed_fmu(tmp_path, **dict.fromkeys([*text, '<Unknown index="19" dependencies="18"/>'], "")).name}
    components = {"r": reference(u=[(0, 1, 1)], b=booleans, e=[(0, 1), *items]), "a": fmu, "c": fmu}
    wires = ["r.u → a.r_in", "r.b → a.b_in", "r.e → a.e_in", "a.b_out → c.i_in", "a.e_out → c.e_in", "a.b_out → c.b_in"]
    how, results, _ = stopped(scenario(tmp_path, components, wires))
    assert told in how
    assert (how == "") == (told == "")
    if not told:
        assert results["c.e_out"].tolist() == [1, 1, 1, 1, 2, 2, 1, 1, 1, 1, 1]


@pytest.mark.parametrize("algorithm", ["jacobi", "gauss-seidel"])
def test_text_and_integers_of_64_bits_are_the_same(tmp_path: Path, algorithm: str) -> None:
    """Recorded, connected, and changed by an event between two changes of their own."""
    source = Model(
        "input u = 0, discrete String mode = start, discrete Int64 n = 9007199254740993, "
        "discrete UInt64 big = 18446744073709551615",
        step='if (t > 0.45) strcpy(mode, u > 0 ? "é \\"zwei\\"" : "drei"); n += t > 0.25; big -= 1 * (t > 0.75);',
        name="source",
    )
    sink = Model(
        "input String s = x, input Int64 i = 1, input String free = own, String so = q, Int64 io = 3",
        calc="strcpy(so, s); io = i + 1;",
        depends={"so": ("s",), "io": ("i",)},
        name="sink",
    )
    components = {"source": {"fmu": str(source.fmu(3))}, "sink": {"fmu": str(sink.fmu(3))}}
    events = [{"at": 0.6, "set": {"source.u": 1, "sink.free": "new"}}]
    wires = ["source.mode → sink.s", "source.n → sink.i"]
    exact = same(tmp_path, components, wires, algorithm=algorithm, events=events).exact
    assert exact["source.mode"] == ["start"] * 6 + ["drei"] + ['é "zwei"'] * 4
    assert exact["sink.s"] == exact["source.mode"]
    assert exact["source.n"][-1] == 9007199254740993 + 7
    assert exact["sink.free"] == ["own"] * 6 + ["new"] * 5
    assert exact["source.big"][-3:] == [18446744073709551615, 18446744073709551614, 18446744073709551613]
    late = 1 if algorithm == "jacobi" else 0
    assert exact["sink.io"][late:] == [n + 1 for n in exact["source.n"]][: 11 - late]


def test_text_is_the_same_beside_inputs_with_courses(tmp_path: Path) -> None:
    source = Model(
        "discrete String mode = start, y = 0", step='y = t + h; if (t > 0.45) strcpy(mode, "late");', name="source"
    )
    sink = Model(
        "input u = 0, input String s = x, y = 0, String so = q",
        step="y += u * h; strcpy(so, s);",
        depends={"y": (), "so": ("s",)},
        name="sink",
    )
    components = {m.name: {"fmu": str(m.fmu(3))} for m in (source, sink)}
    wires = ["source.y → sink.u", "source.mode → sink.s"]
    file = scenario(tmp_path, components, wires, algorithm="gauss-seidel", interpolate="linear", order=[*components])
    usual, plain = both(file)
    assert usual.values.tobytes() == plain.values.tobytes()
    assert usual.exact == plain.exact
    assert plain.exact["sink.so"][-1] == "late"


@pytest.mark.parametrize(("call", "at"), [("SetReal", 9), ("DoStep", 5), ("GetReal", 9)])
@pytest.mark.parametrize("deed", ["warning", "discard", "end", "error", "fatal", "nan"])
def test_what_an_fmu_does_is_told_in_the_same_words_with_the_same_rows(
    tmp_path: Path, call: str, at: int, deed: str
) -> None:
    how, _, said = stopped(ScenarioFile(deeds_scenario(tmp_path, call, deed, at)))
    assert (how == "") == (deed == "warning")
    assert any(f"fmi2{call} returned Warning" in text for text in said) == (deed == "warning")


@pytest.mark.skipif(sys.platform == "win32", reason="has no such signal")
@pytest.mark.parametrize("deed", ["slow", "warning"])
def test_ctrl_c_in_process_is_seen_within_seconds_and_leaves_the_rows(tmp_path: Path, deed: str) -> None:
    file = ScenarioFile(deeds_scenario(tmp_path, "DoStep", deed, at=0, duration=1e6 if deed == "warning" else 100.0))
    system, steps = build_system(file), file.scenario.steps
    table = np.zeros((steps + 1, len(system.columns)))
    rows = Rows(table, tell_loop=lambda _: signal.setitimer(signal.ITIMER_REAL, 0.1))
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    try:
        with pytest.raises(StoppedRun) as end:
            simulate(system, steps, 0.1, rows=rows)
    finally:
        signal.signal(signal.SIGALRM, before)
    assert isinstance(end.value.error, Interrupted)
    assert end.value.results.loop == "C"
    assert 1 < len(end.value.results.time) < steps


@pytest.mark.parametrize(
    ("algorithm", "extrapolate", "interpolate"),
    [
        ("jacobi", "linear", "hold"),
        ("jacobi", "quadratic", "hold"),
        ("gauss-seidel", "linear", "linear"),
        ("gauss-seidel", "quadratic", "linear"),
        ("gauss-seidel", "hold", "quadratic"),
    ],
)
def test_courses_of_inputs_are_the_same_bytes(
    tmp_path: Path, algorithm: str, extrapolate: str, interpolate: str
) -> None:
    """The force of the wheel is that of its inputs at the end of each step, under Jacobi too."""
    components, wires = truck(tmp_path)
    more = {"duration": 1.2, "step": 0.005, "algorithm": algorithm, "record": ["wheel.x*"]}
    held = same(tmp_path, components, wires, **more)
    results = same(tmp_path, components, wires, **more, extrapolate=extrapolate, interpolate=interpolate)
    assert not np.array_equal(results["chassis.y1"], held["chassis.y1"])
    speed, height, foot, seen = (results[f"wheel.{name}"] for name in ("x0", "x1", "x2", "u0"))
    force = 15e3 * (height - foot) + 1e3 * (speed - seen)  # law of coupled.c
    assert results["wheel.y0"] == pytest.approx(force, abs=1e-9)


@pytest.mark.parametrize("algorithm", ["jacobi", "gauss-seidel"])
@pytest.mark.parametrize("course", ["hold", "linear", "quadratic"])
@pytest.mark.parametrize("estimator", ["halving", "residual", "energy"])
def test_controlled_steps_are_the_same_bytes(tmp_path: Path, estimator: str, course: str, algorithm: str) -> None:
    """Steps in C of any length, which are taken back, too."""
    components, wires = truck(tmp_path)
    step = {"max": 0.02, "min": 0.002, "tolerance": 1e-3, "estimator": estimator}
    step |= {"bonds": [{"effort": "wheel.y0", "flow": "chassis.y0"}]} if estimator == "energy" else {}
    more = {"algorithm": algorithm, "extrapolate": course, "interpolate": course}
    file = scenario(tmp_path, components, wires, duration=1.2, step=step, **more)
    found = [(results.values.tobytes(), results.details, results.notes) for results in both(file)]
    assert found[0] == found[1]
    assert found[0][1]["steps"]["accepted"] > 60


def test_python_steps_only_what_c_cannot(tmp_path: Path) -> None:
    """An algebraic loop of y = 0.5·(0.4·y) + 1, model exchange, FMI 1.0 and fixes, beside two masses in C."""
    gain = Model("input u = 0, y, parameter k = 1, parameter c = 0", calc="y = k * u + c;", depends={"y": ("u",)})
    mass = Model("input F = 0, x = 1, v = 0", "x' = v, v' = F - 10 * x", name="mass")
    components = {
        "a": {"fmu": str(mass.fmu())},
        "b": {"fmu": str(mass.fmu(3))},
        "g": {"fmu": str(gain.fmu()), "start": {"k": 0.5, "c": 1}},
        "h": {"fmu": str(gain.fmu()), "start": {"k": 0.4}},
        "exchange": {"fmu": str(mass.fmu(2, "me"))},
        "old": {"fmu": str(mass.fmu(1))},
        "fix": {"block": "fix", "rate": 5, "latency": 0.1, "signals": {"x": {"unit": "", "noise": {"variance": 0.01}}}},
    }
    wires = ["a.x → b.F", "b.x → a.F", "g.y → h.u", "h.y → g.u", "g.y → old.F", "b.x → exchange.F", "a.x → fix.x"]
    file = scenario(tmp_path, components, wires, faults=[{"on": "old.F", "kind": "delay", "delay": 0.2}])
    mixed, plain = both(file)
    assert mixed.loop.startswith("C, but in Python: ")
    assert mixed.details["in_python"]["components"].keys() == {"g", "h", "exchange", "old", "fix"}
    assert 0 < mixed.details["in_python"]["share"] <= 1
    assert mixed.values.tobytes() == plain.values.tobytes()
    assert (mixed.details["loops"], mixed.notes) == (plain.details["loops"], plain.notes)
    assert plain["g.y"] == pytest.approx(1.25, rel=1e-7)
