"""The stepping loop in C: what it calls and when, where it stops and goes on; its rows are the bytes of Python's."""

from __future__ import annotations

import re
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.blocks.coupling import OWN, Algorithm, Plan
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
        found.append((how, results.columns, results.time.tobytes(), results.values.tobytes(), said))
    assert found[0] == found[1]
    return how, results, said


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
    monkeypatch.setattr("cosim.blocks.coupling.OWN", (*OWN, names["REVERSED"]))
    backwards = scenario(tmp_path, components, wires, order=order, algorithm="reversed")
    assert not np.array_equal(stopped(backwards)[1].values, usual.values)
    assert [stage.component.name for stage in build_system(backwards).stages] == ["r", "b", "a"]
    third = type("Third", (Algorithm,), {"name": "third", "plan": lambda *given: Plan(("a",), (False,) * 3)})
    monkeypatch.setattr("cosim.blocks.coupling.OWN", (*OWN, third()))
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
