"""Formats of tables: CSV and Parquet hold the same numbers, whichever way they are read, and each fault is named."""

from __future__ import annotations

import math
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat

import cosim
from cosim.blocks.sources import playback
from cosim.core.arrays import Array
from cosim.core.errors import InputError
from cosim.files.results import Results, read_results
from cosim.files.table import read_columns, read_header, source_of
from cosim.simulation.run_signals import Run
from tests.conftest import ROOT
from tests.full_disk import full_disk
from tests.test_first_steps import told as asked

RECORDED = ROOT / "tests" / "data" / "hovercraft_10s.csv"
TIME = np.arange(5) * 0.5


def parquet(path: Path, columns: dict[str, Any], units: dict[str, str] | None = None) -> Path:
    """Write a Parquet file as another tool would: with units where they are stated."""
    arrays = [pa.array(v) if not isinstance(v, (pa.Array, pa.ChunkedArray)) else v for v in columns.values()]
    about = [{"unit": units[n]} if units and n in units else None for n in columns]
    fields = [pa.field(n, a.type, metadata=m) for n, a, m in zip(columns, arrays, about, strict=True)]
    pq.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields)), path)
    return path


def faults_of(path: Path) -> list[str]:
    with pytest.raises(InputError) as refused:
        read_columns(path)
    assert refused.value.exit_code == 2
    return [str(fault).removeprefix(str(path)) for fault in refused.value.faults]


def as_parquet(log: Path, path: Path) -> Path:
    """A log as Parquet, column by column as CSV has it."""
    read = read_results(log)
    return parquet(path, {"time": read.time, **{name: read[name] for name in read.columns}})


# -- two ways to read CSV ---------------------------------------------------------------------------


def random_csv(rng: np.random.Generator) -> str:
    """A table of odd but plain cells: signs, exponents, blanks, empty cells, line ends of Windows."""
    spellings = ("{:r}", "{:.3g}", "{:.0f}", " {:+.17e}", "{:f} ", "", "nan", "NaN")
    rows = []
    for k in range(int(rng.integers(1, 30))):
        cells = []
        for value in rng.standard_normal(3) * 10.0 ** rng.integers(-20, 20, 3):
            spelling = spellings[rng.integers(len(spellings))]
            cells.append(repr(float(value)) if spelling == "{:r}" else spelling.format(value))
        rows.append(",".join((f"{0.1 * k:.1f}", *cells)))
    end = "\r\n" if rng.random() < 0.3 else "\n"
    return end.join(("time,a [deg],b,c", *rows)) + (end if rng.random() < 0.7 else "")


def test_cells_read_at_once_are_those_read_one_by_one(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    for k in range(200):
        text = random_csv(rng)
        quoted = re.sub(r"^(time.*?\r?\n)([^,]*)", r'\1"\2"', text)  # a quoted cell is read row by row
        columns, results = [], []
        for name, content in (("plain", text), ("quoted", quoted)):
            path = tmp_path / f"{name}{k}.csv"
            path.write_bytes(content.encode())
            table, result = read_columns(path, ["time"]), read_results(path)
            values = {column.name: table[column.name].tobytes() for column in table.columns}
            columns.append((values, list(table.lines), [*table.spoiled], table.header))
            results.append((result.values.tobytes(), result.columns, result.whole, result.units))
        assert columns[0] == columns[1]
        assert results[0] == results[1]


@pytest.mark.parametrize(
    "text",
    [
        "time,x\n0,1\n\n1,2\n", 'time,x\n0,"1"\n1,2\n', "time,x\r0,1\r1,2\r",
        "\n\ntime,x\n0,1\n1,2\n",
        "time,x\n0,1\n1,2\n,\n",
    ],
)  # fmt: skip
def test_what_is_not_plain_is_read_all_the_same(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text, newline="")
    assert read_columns(path)["time"].tolist() == [0.0, 1.0]
    assert read_results(path).time.tolist() == [0.0, 1.0]


def test_every_fault_of_the_rows_of_a_run_is_told_at_once(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time,x\n0,1\n1\n2,3,4\n3,5\n")
    with pytest.raises(InputError) as refused:
        read_results(path)
    assert [f.line for f in refused.value.faults] == [3]
    path.write_text("time,x\n0,1\n,2\n2,3\n1,5\n")
    with pytest.raises(InputError) as refused:
        read_results(path)
    assert [f.line for f in refused.value.faults] == [3, 5]


# -- Parquet ----------------------------------------------------------------------------------------


def test_units_of_a_column_are_in_its_metadata_or_its_name(tmp_path: Path) -> None:
    stated = parquet(tmp_path / "a.parquet", {"time": TIME * 1e3, "psi": TIME}, {"time": "ms", "psi": "deg"})
    named = parquet(tmp_path / "b.parquet", {"time [ms]": TIME * 1e3, "psi [deg]": TIME})
    for path in (stated, named):
        table = read_columns(path)
        assert table["time"].tolist() == TIME.tolist()
        assert table.by_name["psi"].unit == "deg"
        assert read_header(path) == ["time", "psi"]
    assert playback("r", stated).functions[0](1.0) == pytest.approx(math.radians(1.0))


@pytest.mark.parametrize("suffix", [".parquet", ".mat", ".h5"])
def test_rows_of_every_kind_come_back_as_from_csv(tmp_path: Path, suffix: str) -> None:
    values: Array = np.column_stack(
        (TIME**3 / 3.0, [0.0, 1.0, -2.0, 3.0, 4.0], [np.nan, 1e-300, -0.0, 5e-324, 1.7e308])
    )
    exact: dict[str, list[Any]] = {
        "a.text": ["on", "", "a,b", '"', "é"],
        "a.count": [2**63 + k for k in range(5)],
        "a.raw": [b"\x00\xff"] * 5,
    }
    written = Results(TIME, ("a.x", "a.n", "a.odd"), values, {"a.x": "m"}, exact, frozenset({"a.n"}))
    read = []
    for each in (".csv", suffix):
        written.write(tmp_path / f"r{each}")
        read.append(read_results(tmp_path / f"r{each}", {"a.x": "m"}, tuple(exact)))
    csv, other = read
    assert csv.values.tobytes() == other.values.tobytes() == values.tobytes()
    assert (csv.columns, csv.units, csv.exact, csv.whole) == (other.columns, other.units, other.exact, other.whole)
    assert written.write_what_fits(tmp_path / f"fits{suffix}") == 5


@pytest.mark.parametrize(
    ("columns", "told"),
    [
        ({"x": TIME}, 'the first column is "x"; it must be "time"'),
        ({"time": TIME, "x": [[1.0], [2.0], [], [3.0], [4.0]]}, "column x holds list<element: double>; write numbers"),
        ({"time": TIME, "x": [{"y": 1.0}] * 5}, "column x holds struct<y: double>"),
        ({"time": TIME, "x": list("abcde")}, "column x holds text; write numbers"),
        ({"time": TIME, "x": pa.array([1, 2, 3, 4, 5], pa.decimal128(5, 2))}, "column x holds decimal128(5, 2)"),
        ({"time": pa.array([0, 1, 2, 3, 4], pa.timestamp("ms"))}, "column time holds text"),
        ({"time": pa.array([0, 1, 2, 3, 4], pa.duration("s"))}, "times in seconds"),
        ({"time": [0.0, None, 1.0, 1.5, 2.0], "x": TIME}, ":2:1: time has no value here"),
        ({"time": [0.0, 1.0, 0.9, 1.5, 2.0], "x": TIME}, ":3:1: time 0.9 s does not increase"),
        ({"time": TIME, "x": [1.0, None, 2.0, 3.0, 4.0]}, ":2:2: x has no value here"),
        ({"time": TIME, "x": [1.0, math.inf, 2.0, 3.0, 4.0]}, ':2:2: "inf" in column x is not finite'),
        ({"time": [], "x": []}, "holds no row"),
        ({}, "has no columns"),
    ],
)  # fmt: skip
def test_a_fault_of_a_parquet_file_has_its_place(tmp_path: Path, columns: dict[str, Any], told: str) -> None:
    path = parquet(tmp_path / "a.parquet", columns)
    assert told in "\n".join(faults_of(path))


def test_a_torn_file_is_one_message(tmp_path: Path) -> None:
    whole = as_parquet(RECORDED, tmp_path / "whole.parquet").read_bytes()
    torn = tmp_path / "torn.parquet"
    for size in (0, 3, 8, 100, len(whole) // 2, len(whole) - 1):
        torn.write_bytes(whole[:size])
        assert len(told := faults_of(torn)) == 1
        assert told[0].startswith(": is no whole Parquet file")
    torn.write_bytes(whole[: len(whole) // 2] + whole[-200:])
    assert len(faults_of(torn)) == 1


# -- verbs --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("format_", "words"),
    [("xls", r"known here: CSV \(.csv\), Parquet \(.parquet\)"), ("hdf5", r"pip install 'fmu-cosim\[hdf5\]'")],
)
def test_a_format_that_cannot_be_written_is_told_before_any_work(
    project: Path, monkeypatch: pytest.MonkeyPatch, format_: str, words: str
) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(InputError, match=words):
        cosim.run(project / "scenarios" / "regulate.yaml", project / "out", format=format_)
    assert not (project / "out").exists()


# -- formats of other tools --------------------------------------------------------------------------------


def _results(folder: Path, suffix: str) -> Path:
    values = np.column_stack((TIME**2, 2.0 * TIME))
    Results(TIME, ("tank.level", "tank.a[1]"), values, {"tank.level": "m"}).write(folder / f"r{suffix}")
    return folder / f"r{suffix}"


def test_mat_is_read_by_scipy_and_variables_of_other_tools_become_columns(tmp_path: Path) -> None:
    scipy_io = pytest.importorskip("scipy.io")
    content = scipy_io.loadmat(_results(tmp_path, ".mat"), simplify_cells=True)
    assert list(content["names"]) == ["tank.level", "tank.a[1]"]
    assert content["values"][:, 0].tolist() == (TIME**2).tolist()
    scipy_io.savemat(tmp_path / "other.mat", {"t": TIME, "level": TIME**2, "gain": 3.0, "note": "text"})
    other = read_results(tmp_path / "other.mat")
    assert other.columns == ("level",)
    assert other["level"].tolist() == (TIME**2).tolist()


def test_hdf5_is_read_by_h5py_and_datasets_of_other_tools_become_columns(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(_results(tmp_path, ".h5")) as file:
        assert file["tank/level"][:].tolist() == (TIME**2).tolist()
        assert dict(file["tank/level"].attrs) == {"name": "tank.level", "unit": "m", "column": 1}
    with h5py.File(tmp_path / "other.hdf5", "w") as file:
        file["time"], file["run/level [cm]"], file["run/short"] = TIME, TIME**2, [1.0]
    other = read_results(tmp_path / "other.hdf5")
    assert (other.columns, other.units) == (("run.level",), {"run.level": "cm"})


@pytest.mark.parametrize(
    ("columns", "index", "names"),
    [
        ("x T", {"time": TIME}, ["x", "T"]),
        ("x T", {None: TIME}, ["x", "T"]),
        ("x T", {"time [ms]": TIME * 1000}, ["x", "T"]),
        ("T time", {}, ["T"]),
        ("T time", {None: [0, 2, 4, 6, 8]}, ["T"]),  # rows of a longer table
        ("x time", {"T": TIME + 300}, ["x", "T"]),
        ("x", {"run": [1, 1, 1, 2, 2], "time": TIME}, ["x", "run"]),
    ],
)
def test_the_index_of_a_pandas_table_is_its_time(
    tmp_path: Path, columns: str, index: dict[str, Any], names: list[str]
) -> None:
    pandas = pytest.importorskip("pandas")
    made = [*index.values()]
    kept = pandas.MultiIndex.from_arrays(made, names=[*index]) if len(made) > 1 else None
    kept = pandas.Index(made[0], name=next(iter(index))) if len(made) == 1 else kept
    values = {name: TIME if name == "time" else TIME + k for k, name in enumerate(columns.split())}
    pandas.DataFrame(values, index=kept).to_parquet(tmp_path / "a.parquet")
    read = read_results(tmp_path / "a.parquet")
    assert (list(read.columns), read.time.tolist()) == (names, TIME.tolist())
    assert [*read_columns(tmp_path / "a.parquet").by_name] == ["time", *names] == read_header(tmp_path / "a.parquet")


@pytest.mark.skipif(sys.platform == "win32", reason="no limits of files")
@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".mat", ".h5"])
def test_rows_that_fit_on_a_full_disk_are_written_in_each_format(tmp_path: Path, suffix: str) -> None:
    if suffix == ".h5":
        pytest.importorskip("h5py")
    values = np.random.default_rng(1).normal(size=(20_000, 2))
    rows, file = Results(np.arange(20_000.0), ("a.x", "b.y"), values), tmp_path / f"results{suffix}"
    with full_disk(200_000):
        with pytest.raises(OSError, match="large"):
            rows.write(file)
        count = rows.write_what_fits(file)
    assert 0 < count < 20_000
    np.testing.assert_array_equal(read_results(file).values, values[:count])
    assert [path.name for path in tmp_path.iterdir()] == [file.name]


@pytest.mark.parametrize("format_", ["parquet", "mat", "hdf5"])
def test_a_run_in_another_format_is_read_again(tmp_path: Path, format_: str) -> None:
    (tmp_path / "s.yaml").write_text(
        "name: s\nduration: 1\nstep: 0.1\ncomponents:\n  ref:\n    block: reference\n"
        "    signals: {x: {start: 1, unit: m, changes: [{at: 0.5, to: 2}]}}\n",
        encoding="utf-8",
    )
    ran = cosim.run(tmp_path / "s.yaml", tmp_path / "out", format=format_, report=False)
    read = cosim.read(tmp_path / "out")
    assert isinstance(read, Run)
    assert read.results.values.tobytes() == ran.results.values.tobytes()
    assert read.results.units == ran.results.units
    (rows,) = (tmp_path / "out").glob("results.*")
    alone = shutil.copy(rows, tmp_path / f"alone{rows.suffix}")  # a file without its manifest
    assert cosim.read(alone).to_pandas().to_numpy().tobytes() == read.to_pandas().to_numpy().tobytes()
    asked("check", alone)


@pytest.mark.parametrize("suffix", ["mat", "h5"])
def test_a_temperature_is_no_time_and_its_unit_and_large_numbers_are_kept(tmp_path: Path, suffix: str) -> None:
    path, content = tmp_path / f"a.{suffix}", {"T": np.array([300.0, 301.0]), "t [ms]": np.array([0.0, 100.0])}
    content["n"] = np.array([2**64 - 1, 1], dtype=np.uint64)
    if suffix == "mat":
        savemat(path, content)
    else:
        with pytest.importorskip("h5py").File(path, "w") as file:
            for name, values in content.items():
                file[name] = values
    time, *others = source_of(path).read(path).columns
    assert (time.name, time.unit, list(time.values)) == ("time", "ms", [0.0, 100.0])
    assert {c.name: list(c.values) for c in others} == {"T": [300.0, 301.0], "n": [2.0**64, 1.0]}
