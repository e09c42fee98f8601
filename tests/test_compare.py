"""Comparison of runs with a baseline: tolerances, units, times, texts; two or more runs."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cosim
from cosim.comparison.differences import Compared, compare_runs
from cosim.comparison.several import ComparedRuns
from cosim.core.errors import CriterionMissed, InputError
from cosim.files.results import Results
from cosim.simulation.run_signals import RecordedRun
from tests.slider import slider_fmu
from tests.test_first_steps import invoked, told

TIME = np.linspace(0, 1, 101)
EPS = float(np.finfo(float).eps)


def ran(name: str = "a", time: Any = TIME, /, text: Any = None, unit: str = "", **signals: Any) -> RecordedRun:
    """Return a run of these signals, all of which have one unit."""
    time = np.asarray(time)
    table = np.zeros((time.size, len(signals)))
    for k, values in enumerate(signals.values()):
        table[:, k] = values
    units = dict.fromkeys(signals, unit) if unit else {}
    return RecordedRun(Path(name), name, Results(time, tuple(signals), table, units, exact=text or {}))


def held(a: Any, b: Any, tolerance: float | None = None, absolute: float = 0.0) -> Compared:
    return compare_runs(ran(x=a), ran("b", x=b), tolerance, absolute)


def test_a_tolerance_is_a_share_of_the_range_or_absolute_and_a_difference_of_its_size_is_within_it() -> None:
    a = 4.0 * TIME
    b = a + np.where(TIME == 0.5, 1.0, 0.0)
    for tolerance, absolute in ((0.25, 0.0), (0.0, 1.0), (0.125, 0.5)):
        assert held(a, b, tolerance, absolute).same
        (found,) = held(a, b, tolerance * (1 - 1e-9), absolute * (1 - 1e-9)).beyond
        assert (found.name, found.at) == ("x", 0.5)


def test_runs_that_share_not_all_signals_or_times_are_told_so() -> None:
    one = ran(x=TIME)
    with pytest.raises(InputError, match=r"^b: .* a: y .* x"):
        compare_runs(one, ran("b", y=TIME))
    with pytest.raises(InputError, match=r"^b: .* 5 … 6 s .* 0 … 1 s"):
        compare_runs(one, ran("b", TIME + 5, x=TIME))
    lost = compare_runs(ran(x=TIME, y=TIME), ran("b", x=TIME), 1.0)
    assert lost.reasons == ["1 signal of a is missing in b: y"]
    assert lost.verdict()["within"] is False
    assert compare_runs(one, ran("b", x=TIME, y=TIME), 0.0).same  # only the other has it
    late = ran("b", TIME[30:], x=TIME[30:])
    for found in (compare_runs(one, late, 1.0), compare_runs(late, one, 1.0)):
        assert not found.same
        assert found.shorter == "a begins at 0 s, b at 0.3 s"


def test_units_of_one_dimension_are_converted_and_those_of_two_are_told_by_name() -> None:
    a = ran(unit="rad/s", w=np.sin(TIME))
    assert compare_runs(a, ran("b", unit="rpm", w=np.sin(TIME) * 30 / math.pi), 0.0).differences[0].largest == 0
    other = compare_runs(a, ran("b", unit="deg/s", w=np.sin(TIME)), 0.1)
    assert other.beyond[0].share == pytest.approx(1 - math.pi / 180)
    none = compare_runs(a, ran("b", unit="m", w=np.sin(TIME)), 1.0)
    assert not none.same
    assert none.differences[0].as_json()["largest"] is None
    assert compare_runs(a, ran("b", w=np.sin(TIME)), 0.0).same  # a column without a unit is of that of the other


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])  # rounding is a share of the value, however large that is
def test_a_change_of_unit_there_and_back_is_no_difference_and_a_little_more_is(size: float) -> None:
    degrees = size * np.linspace(1.0, 100.0, 101)
    radians = ran(unit="rad", x=np.radians(degrees))
    assert compare_runs(radians, ran("b", unit="deg", x=degrees), 0.0).same
    assert not compare_runs(radians, ran("b", unit="deg", x=degrees * (1.0 + 20 * EPS)), 0.0).same
    # without a change of unit the last bit counts
    assert not held(degrees, degrees * (1.0 + EPS), 0.0).same


def test_compare_exits_5_beyond_the_tolerance_alone_and_leaves_a_page(tmp_path: Path) -> None:
    a, b, out = tmp_path / "a.csv", tmp_path / "b.csv", tmp_path / "c"
    a.write_text("time,x [m]\n0,0\n1,1\n")
    b.write_text("time,x [m]\n0,0\n1,1.1\n")
    told("compare", a, b, "--out", out)
    assert "x minus a" in (out / "report.html").read_text()
    told("compare", a, b, "--tol", "0.11", "--out", out, "--force")
    told("compare", a, b, "--tol", "0.09", "--out", out, "--force", code=5)
    record = json.loads((out / "comparison.json").read_text())
    assert record["within"] is False
    (x,) = record["signals"]
    assert x["name"] == "x"
    assert (x["differences"][1]["largest"], x["differences"][1]["beyond"]) == (pytest.approx(0.1), True)


def test_what_is_no_run_is_told_by_compare_and_report(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for name, text, words in (
        ("empty", "", "empty: this folder has no results.csv"),
        ("empty.csv", "", "is empty"),
        ("ragged.csv", "time,x\n0,0\n1\n", "ragged.csv:3:1: has 1 cell, the header 2"),
        ("hole.csv", "time,x\n0,0\n,1\n1,2\n", "hole.csv:3:1: "),
    ):
        if "csv" in name:
            (tmp_path / name).write_text(text)
        assert words in told("compare", tmp_path / name, tmp_path / name, code=2)
    assert "empty: has no manifest.json" in told("report", tmp_path / "empty", code=2)


COARSE = np.array([0.0, 1.0, 2.0])


@pytest.mark.parametrize(
    ("times", "values", "largest", "at"),
    [
        ([0.0, 0.5, 1.0, 2.0], [1.0, 1.3, 2.0, 3.0], 0.0, 0.0),  # on the way
        ([0.0, 0.5, 1.0, 2.0], [1.0, 77.0, 2.0, 3.0], 75.0, 0.5),  # a spike
        ([0.0, 1.0, 1.0, 2.0], [1.0, 9.0, 2.0, 3.0], 6.0, 1.0),  # at an event
        ([0.0, 1.0, 2.0, 2.0], [1.0, 2.0, 3.0, 2.5], 0.0, 0.0),  # at the last
        ([0.0, 0.5, 1.0, 2.0], [1.0, math.nan, 2.0, 3.0], math.inf, 0.5),
    ],
)
def test_rows_between_those_of_the_other_are_held_against_what_these_span(
    times: list[float], values: list[float], largest: float, at: float
) -> None:
    (found,) = compare_runs(ran("a", COARSE, x=COARSE + 1.0), ran("b", times, x=values), 1e-6).differences
    assert (found.largest, found.at if largest else 0.0, found.beyond) == (largest, at, largest > 0)


@pytest.mark.parametrize(("words", "at"), [("xxyy", None), ("xxqy", 1.5), ("qqqq", 0.0), ("qxxy", 0.0)])
def test_text_between_rows_may_change_a_row_early_and_say_nothing_else(words: str, at: float | None) -> None:
    a = ran("a", COARSE, text={"s": ["x", "x", "y"]})
    found = compare_runs(a, ran("b", [0.0, 1.0, 1.5, 2.0], text={"s": [*words]}), 0.0)
    assert [d.at for d in found.beyond] == ([] if at is None else [at])
    assert found.same == (at is None)


def test_largest_rms_scale_and_share_are_their_formulas() -> None:
    rows = np.arange(101.0)
    (found,) = held(0.04 * rows - 1.0, 0.04 * rows - 1.0 + np.where(rows % 10 == 0, -0.5, 0.0)).differences
    assert (found.largest, found.scale, found.share) == pytest.approx((0.5, 4.0, 0.125))
    assert round(100 * found.at) % 10 == 0
    assert found.rms == pytest.approx(0.5 * math.sqrt(11 / 101))
    other = held(-3.0, -3.3)  # without a tolerance nothing is beyond
    assert (other.same, other.beyond, other.verdict()["within"]) == (False, [], None)
    assert other.differences[0].share == pytest.approx(0.1)
    assert held(0.0, 0.25).differences[0].share == 0.25  # a signal that is zero has no size: 1 in its unit
    (found,) = held(np.where(TIME > 0.5, np.nan, 2.0 * TIME), TIME).differences
    assert (found.scale, found.largest, found.rms) == (pytest.approx(1.0), math.inf, math.inf)


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_a_tolerance_that_is_none_is_refused(value: float) -> None:
    for option in ("tolerance", "absolute"):
        with pytest.raises(InputError, match=f"^{option}: is {value}"):
            cosim.compare(["a.csv", "b.csv"], **{option: value})


# -- any number of runs against a baseline ---------------------------------------------------------

SCENARIO = "name: s\nduration: 1\nstep: 0.1\ncomponents:\n  ref: {block: reference, signals: {x: {start: 1}}}\n"
CRITERION = "criteria: {peak: {of: ref.x, max: 2.5}}\n"
ODD = """{"scenario": [1], "criteria": "x", "units": [1], "beside": 3, "versions": "no", "git": [1], "fmus": ["a"],
"schema_version": 99, "cosim_version": "99.0"}"""


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose results have three runs of a scenario with other start values."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "s.yaml").write_text(SCENARIO + CRITERION, encoding="utf-8")
    for start in (1, 3, 2):
        content = {"set": {"components.ref.signals.x.start": start}, "report": False, "in_process": True}
        cosim.run(folder / "s.yaml", folder / "results" / "s" / f"000{start}", **content)  # type: ignore[arg-type]
    return folder


def _invoke(*words: str) -> Any:
    return invoked("compare", *words)


def test_the_command_compares_runs_of_a_pattern(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(runs)
    (runs / "results" / "s-sweep").mkdir(exist_ok=True)
    (runs / "results" / "s-sweep" / "sweep.json").write_text("{}")  # results without rows
    done = _invoke("s*", "--baseline", "3", "--out", "out", "--json")
    assert done.exit_code == 0, done.output
    content = json.loads(done.output)
    labels = [f"run {k} (ref.signals.x.start = {v})" for k, v in ((1, 1), (2, 3), (3, 2))]
    assert [r["label"] for r in content["runs"]] == labels
    assert content["baseline"] == labels[2]
    assert content["inputs"] == [{"kind": "scenario", "name": "ref.signals.x.start", "values": [1.0, 3.0, 2.0]}]
    (criterion,) = content["criteria"]
    assert [o["met"] for o in criterion["outcomes"]] == [True, False, True]
    assert [d and d["largest"] for d in content["signals"][0]["differences"]] == [1.0, 1.0, None]
    assert "<h1>2 runs against run 3</h1>" in (runs / "out" / "report.html").read_text(encoding="utf-8")
    missed = _invoke("1", "2", "3", "--out", "judged", "--tol", "0.1", "--no-report").exception
    assert isinstance(missed, CriterionMissed)
    assert "run 2 (ref.signals.x.start = 3): 1 signal beyond the tolerance" in str(missed)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["1"], "at least two"),
        (["1", "2", "--baseline", "s/*"], "3 runs match"),
        (["1", "9"], "no such folder, file or results"),
        (["1", "x*"], "no such folder, file or results"),
        (["1", "3", "--out", "results/s/0002"], "results/s/0002"),  # what is there is of others
    ],
)
def test_what_cannot_be_compared_is_one_message(
    runs: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], message: str
) -> None:
    monkeypatch.chdir(runs)
    error = _invoke(*words).exception
    assert isinstance(error, InputError)
    assert message in str(error)


def test_python_compares_lists_of_folders_numbers_and_results(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(runs)
    here = cosim.run("s.yaml", report=False, in_process=True)
    found = cosim.compare([1, "results/s/0003", here], baseline=here)
    assert isinstance(found, ComparedRuns)
    assert found.baseline == 2
    assert found.comparisons[0].same
    frame = pytest.importorskip("pandas") and found.to_pandas()
    assert frame.loc["ref.x"].tolist() == [0.0, 2.0]


def test_results_of_other_versions_and_half_written_ones_are_compared_by_their_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    records = {"new": ODD, "cut": '{"scenario": {"na', "empty": "", "gone": "{}", "torn": "{}"}
    for gain, (name, record) in enumerate(records.items(), 1):
        (folder := tmp_path / "results" / name).mkdir(parents=True)
        Results(TIME, ("a.x",), gain * TIME[:, None]).write(folder / "results.csv")
        (folder / "manifest.json").write_text(record, encoding="utf-8")
    (tmp_path / "results" / "gone" / "results.csv").unlink()
    (tmp_path / "results" / "torn" / "results.csv").write_text("time,a.x\n0,1\n0.1")
    done = _invoke("*", "--baseline", "new", "--out", "out", "--json")
    assert done.exit_code == 0, done.output
    labels = [r["label"].partition("(")[2] for r in json.loads(done.stdout)["runs"]]
    assert sorted(labels) == ["cut)", "empty)", "new)"]
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "results/torn/results.csv:3:1: has 1 cell, the header 2" in page
    for name, message in (("gone", "this folder has no"), ("torn", "has 1 cell, the header 2")):
        assert message in str(_invoke("new", name).exception)


def test_an_input_that_a_run_does_not_set_has_the_start_value_of_the_fmu(tmp_path: Path) -> None:
    slider_fmu(tmp_path / "slider.fmu")
    (tmp_path / "s.yaml").write_text("name: s\nduration: 1\nstep: 0.1\ncomponents: {slider: {fmu: slider.fmu}}\n")
    for name, given in (("a", None), ("b", {"slider.mass": 2.5})):
        cosim.run(tmp_path / "s.yaml", tmp_path / name, given, report=False, in_process=True)
    cosim.compare(tmp_path / "a", tmp_path / "b", out=tmp_path / "out")
    content = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert {row["name"]: row["values"] for row in content["inputs"]} == {"slider.mass": ["1.0 (FMU)", 2.5]}
