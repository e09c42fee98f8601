"""Two runs held against each other: tolerances, units, times, texts; and the page of a run made again."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cosim
from cosim.comparison.differences import Compared, compare_runs
from cosim.core.arrays import Array
from cosim.core.errors import InputError
from cosim.files.artefact import kind_by_keys
from cosim.files.results import Results
from cosim.simulation.run_signals import RecordedRun
from tests.test_first_steps import told
from tests.typed import typed_fmu

TIME = np.linspace(0, 1, 101)
EPS = float(np.finfo(float).eps)


def ran(name: str = "a", time: Array = TIME, /, text: Any = None, units: Any = None, **signals: Any) -> RecordedRun:
    columns = [np.broadcast_to(values, time.shape) for values in signals.values()]
    table = np.column_stack(columns) if columns else np.zeros((time.size, 0))
    return RecordedRun(Path(name), name, Results(time, tuple(signals), table, units or {}, exact=text or {}))


def held(a: Any, b: Any, tolerance: float | None = None, absolute: float = 0.0) -> Compared:
    return compare_runs(ran(x=a), ran("b", x=b), tolerance, absolute)


def test_a_tolerance_is_a_share_of_the_range_and_what_is_beyond_it_is_named() -> None:
    a = 10 * TIME
    b = a + np.where(TIME[30] == TIME, 0.2, 0.0)
    (found,) = held(a, b, 0.019).beyond
    assert found.name == "x"
    assert found.at == pytest.approx(0.3)
    assert found.largest == pytest.approx(0.2)
    assert found.share == pytest.approx(0.02)
    assert held(a, b, 0.021).same
    assert held(a, b, 0.0, absolute=0.21).same


def test_runs_that_share_no_signal_or_no_time_are_told_so() -> None:
    with pytest.raises(InputError, match="b: shares no signal with a: it has y; that has x"):
        compare_runs(ran(x=TIME), ran("b", y=TIME))
    with pytest.raises(InputError, match=r"b: shares no time with a: it has 5 … 6 s, that 0 … 1 s"):
        compare_runs(ran(x=TIME), ran("b", TIME + 5, x=TIME))


def test_a_signal_that_only_the_baseline_has_is_missed_and_one_that_only_the_other_has_is_not() -> None:
    more, fewer = ran(x=TIME, y=TIME), ran("b", x=TIME)
    lost = compare_runs(more, fewer, 1.0)
    assert not lost.same
    assert lost.reasons == ["1 signal of a is missing in b: y"]
    assert "1 signal of a is not in b" in repr(lost)
    assert lost.as_json()["within"] is False
    assert compare_runs(fewer, more, 0.0).same


def test_a_run_that_begins_late_is_not_the_same_whichever_stands_first() -> None:
    late = ran("b", TIME[30:], x=TIME[30:])
    for found in (compare_runs(ran(x=TIME), late, 1.0), compare_runs(late, ran(x=TIME), 1.0)):
        assert not found.same
        assert found.shorter == "a begins at 0 s, b at 0.3 s"


def test_units_of_one_dimension_are_converted_and_those_of_two_are_told_by_name() -> None:
    a = ran(units={"w": "rad/s"}, w=np.sin(TIME))
    same = compare_runs(a, ran("b", units={"w": "rpm"}, w=np.sin(TIME) * 30 / math.pi), 0.0)
    assert same.same
    assert same.differences[0].largest == 0
    other = compare_runs(a, ran("b", units={"w": "deg/s"}, w=np.sin(TIME)), 0.1)
    assert other.beyond[0].share == pytest.approx(1 - math.pi / 180)
    none = compare_runs(a, ran("b", units={"w": "m"}, w=np.sin(TIME)), 1.0)
    assert not none.same
    assert "w is in rad/s in one, in m in the other" in repr(none)
    assert "equal" not in repr(none)
    assert none.as_json()["signals"][0]["largest"] is None
    assert compare_runs(a, ran("b", w=np.sin(TIME)), 0.0).same  # a column without a unit is of that of the other


def test_times_in_other_units_are_seconds_wherever_a_csv_is_read(tmp_path: Path) -> None:
    (tmp_path / "s.csv").write_text("time,r_in\n0,0\n0.1,1\n0.2,2\n")
    (tmp_path / "ms.csv").write_text("time [ms],r_in\n0,0\n100,1\n200,2\n")
    (tmp_path / "no.csv").write_text("time [ft],r_in\n0,0\n1,1\n")
    told("compare", tmp_path / "s.csv", tmp_path / "ms.csv", "--tol", "1e-9", "--out", tmp_path / "c")
    fmu = typed_fmu(tmp_path)
    for name in ("s", "ms"):
        out = ["--out", tmp_path / name, "--no-report", "--in-process"]
        told("simulate", fmu, "--input", tmp_path / f"{name}.csv", "--step", "0.1", *out)
    assert (tmp_path / "s" / "results.csv").read_bytes() == (tmp_path / "ms" / "results.csv").read_bytes()
    why = 'no.csv:1:1: "ft" is no unit of time; known here: s, ms'
    assert why in told("compare", tmp_path / "s.csv", tmp_path / "no.csv", code=2)
    assert why in told("simulate", fmu, "--input", tmp_path / "no.csv", "--out", tmp_path / "o", code=2)


def two_runs(folder: Path) -> tuple[Path, Path]:
    fmu = typed_fmu(folder)
    for name, value in (("a", 1.0), ("b", 1.5)):
        told(
            "simulate",
            "--in-process",
            fmu,
            "--set",
            f"r_in={value}",
            "--stop",
            "0.2",
            "--step",
            "0.1",
            "--out",
            folder / name,
        )
    return folder / "a", folder / "b"


def test_compare_exits_5_beyond_the_tolerance_alone_and_leaves_a_page(tmp_path: Path) -> None:
    a, b = two_runs(tmp_path)
    out = ["--out", tmp_path / "c", "--force"]
    told("compare", a, b, *out)
    page = (tmp_path / "c" / "report.html").read_text()
    assert "typed.r_out, b − a" in page
    assert told("compare", a, b, "--tol", "0.6", *out)
    assert "signals beyond the tolerance" in told("compare", a, b, "--tol", "0.4", *out, code=5)
    record = json.loads((tmp_path / "c" / "comparison.json").read_text())
    assert kind_by_keys(record) == "an answer of `cosim compare`"
    assert record["within"] is False
    (r_out,) = (s for s in record["signals"] if s["name"] == "typed.r_out")
    assert (r_out["largest"], r_out["beyond"]) == (0.5, True)


def test_compare_takes_csvs_of_other_tools(tmp_path: Path) -> None:
    for name, last in (("a", 1.0), ("b", 1.1)):
        (tmp_path / f"{name}.csv").write_text(f"time,x [m]\n0,0\n1,{last}\n")
    told("compare", tmp_path / "a.csv", tmp_path / "b.csv", "--tol", "0.11", "--out", tmp_path / "c")
    told("compare", tmp_path / "a.csv", tmp_path / "b.csv", "--tol", "0.09", "--out", tmp_path / "d", code=5)


def test_what_is_no_run_is_told_by_compare_and_report(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty.csv").touch()
    (tmp_path / "ragged.csv").write_text("time,x\n0,0\n1\n")
    (tmp_path / "late.csv").write_text("x,time\n0,0\n")
    (tmp_path / "back.csv").write_text("time,x\n0,0\n2,1\n1,2\n")
    (tmp_path / "hole.csv").write_text("time,x\n0,0\n,1\n1,2\n")
    fmu = typed_fmu(tmp_path)
    for given, words in (
        (tmp_path / "empty", "empty: holds no rows: no results.csv or results.parquet or results.mat or"),
        (tmp_path / "empty.csv", "is empty"),
        (tmp_path / "none", "none: no such folder or file; give the folder of a run"),
        (tmp_path / "ragged.csv", "ragged.csv:3:1: has 1 cell, the header 2"),
        (tmp_path / "back.csv", "back.csv:4:1: time 1 s does not increase"),
        (tmp_path / "hole.csv", "hole.csv:3:1: "),
        (tmp_path / "late.csv", 'the first column is "x"; it must be "time" [s]'),
        (fmu, "is an FMU, not a log"),
    ):
        assert words in told("compare", given, given, code=2)
    for given, words in (
        (tmp_path / "empty", "empty: has no manifest.json; give the folder with the results of `cosim run`"),
        (tmp_path / "none", "no such file"),
        (fmu, "is an FMU, not a folder that a run left"),
    ):
        assert words in told("report", given, code=2)


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
    found = compare_runs(ran("a", COARSE, x=COARSE + 1.0), ran("b", np.array(times), x=np.array(values)), 1e-6)
    (d,) = found.differences
    assert (d.largest, d.at if largest else 0.0, d.beyond) == (largest, at, largest > 0)
    assert ("between rows of a" in d.note) == (largest > 0)


def test_text_between_rows_may_change_a_row_early_and_say_nothing_else() -> None:
    def spoken_run(name: str, time: list[float], words: list[str]) -> RecordedRun:
        return ran(name, np.array(time), text={"s": words})

    a = spoken_run("a", [0.0, 1.0, 2.0], ["x", "x", "y"])
    assert compare_runs(a, spoken_run("b", [0.0, 1.0, 1.5, 2.0], ["x", "x", "y", "y"]), 0.0).same
    (d,) = compare_runs(a, spoken_run("b", [0.0, 1.0, 1.5, 2.0], ["x", "x", "q", "y"]), 0.0).beyond
    assert d.at == 1.5
    for words in (["q", "q", "q", "q"], ["q", "x", "x", "y"]):
        (d,) = compare_runs(a, spoken_run("b", [0.0, 1.0, 1.5, 2.0], words), 0.0).beyond
        assert d.at == 0.0


def test_without_a_tolerance_the_same_is_what_is_equal_and_nothing_is_beyond() -> None:
    assert held(TIME, TIME).same
    other = held(TIME, 2.0 * TIME)
    assert (other.same, other.beyond, other.reasons) == (False, [], ["1 signal differs"])
    assert other.as_json()["within"] is None
    found = compare_runs(*(ran(word, COARSE, text={"s": [word] * 3}) for word in "xy"))
    assert (found.same, found.beyond) == (False, [])


# -- edges ----------------------------------------------------------------------------------------


def test_a_difference_of_the_tolerance_itself_is_within_it() -> None:
    a = 4.0 * TIME
    b = a + np.where(TIME == 0.0, 1.0, 0.0)
    for tolerance, absolute in ((0.25, 0.0), (0.0, 1.0), (0.125, 0.5)):
        assert held(a, b, tolerance, absolute).same
        assert not held(a, b, tolerance * (1 - 1e-9), absolute * (1 - 1e-9)).same


def test_largest_rms_scale_and_share_are_their_formulas() -> None:
    rows = np.arange(101.0)
    (found,) = held(0.04 * rows - 1.0, 0.04 * rows - 1.0 + np.where(rows % 10 == 0, -0.5, 0.0)).differences
    assert (found.largest, found.scale, found.share, found.at) == (
        pytest.approx(0.5), pytest.approx(4.0), pytest.approx(0.125), found.at,
    )  # fmt: skip
    assert round(100 * found.at) % 10 == 0
    assert found.rms == pytest.approx(0.5 * math.sqrt(11 / 101))
    assert held(np.full(101, -3.0), np.full(101, -3.3)).differences[0].share == pytest.approx(0.1)
    assert held(0.0, 0.25).differences[0].share == 0.25  # a signal that is zero has no size: 1 in its unit
    (found,) = held(np.where(TIME > 0.5, np.nan, 2.0 * TIME), TIME).differences
    assert (found.scale, found.largest, found.rms) == (pytest.approx(1.0), math.inf, math.inf)


def test_a_change_of_unit_there_and_back_is_no_difference_and_a_little_more_is() -> None:
    degrees = np.linspace(1.0, 100.0, 101)
    radians = ran("a", units={"x": "rad"}, x=np.radians(degrees))
    assert compare_runs(radians, ran("b", units={"x": "deg"}, x=degrees), 0.0).same
    found = compare_runs(radians, ran("b", units={"x": "deg"}, x=degrees * (1.0 + 20 * EPS)), 0.0)
    assert not found.same
    assert found.differences[0].note == "deg in b, converted"
    for size in (1e-6, 1e6):  # rounding is a share of the value, however large that is
        small = ran("a", units={"x": "rad"}, x=size * np.radians(degrees))
        assert compare_runs(small, ran("b", units={"x": "deg"}, x=size * degrees), 0.0).same
        off = size * degrees * (1.0 + 20 * EPS)
        assert not compare_runs(small, ran("b", units={"x": "deg"}, x=off), 0.0).same
    # without a change of unit the last bit counts
    assert not held(degrees, degrees * (1.0 + EPS), 0.0).same


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_a_tolerance_that_is_none_is_refused(value: float, tmp_path: Path) -> None:
    for option in ("tolerance", "absolute"):
        with pytest.raises(InputError, match=f"^{option}: is {value}"):
            cosim.compare(["a.csv", "b.csv"], out=tmp_path / "out", **{option: value})
    assert not (tmp_path / "out").exists()
