"""Formats of tables: CSV and Parquet hold the same numbers, whichever way they are read, and each fault is named."""

from __future__ import annotations

import math
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import loadmat, savemat

import cosim
from cosim.blocks.sources import playback
from cosim.core.arrays import Array
from cosim.core.errors import InputError
from cosim.files.results import Results, read_results
from cosim.files.table import Column, read_columns, read_header, source_named

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


# -- two ways to read CSV ---------------------------------------------------------------------------


def random_csv(rng: np.random.Generator) -> str:
    """A table of odd but plain cells: signs, exponents, blanks, empty cells, line ends of Windows."""
    spellings, rows = ("{!r}", "{:.3g}", "{:.0f}", " {:+.17e}", "{:f} ", "", "nan", "NaN"), ["time,a [deg],b,c"]
    for k in range(int(rng.integers(1, 30))):
        values = (rng.standard_normal(3) * 10.0 ** rng.integers(-20, 20, 3)).tolist()
        rows.append(",".join([f"{0.1 * k:.1f}", *(spellings[rng.integers(8)].format(value) for value in values)]))
    end = "\r\n" if rng.random() < 0.3 else "\n"
    return end.join(rows) + (end if rng.random() < 0.7 else "")


def test_cells_read_at_once_are_those_read_one_by_one(tmp_path: Path) -> None:
    rng, path, found = np.random.default_rng(7), tmp_path / "a.csv", list[Any]()
    for _ in range(200):
        text = random_csv(rng)
        for content in (text, re.sub(r"^(time.*?\r?\n)([^,]*)", r'\1"\2"', text)):  # a quoted cell is read row by row
            path.write_bytes(content.encode())
            table, result = read_columns(path, ["time"]), read_results(path)
            values = {column.name: table[column.name].tobytes() for column in table.columns}
            about = values, list(table.lines), [*table.spoiled], table.header
            found.append((about, result.values.tobytes(), result.columns, result.whole, result.units))
        assert found[-1] == found[-2]


@pytest.mark.parametrize(
    "text", ["time,x\n0,1\n\n1,2\n", "time,x\r0,1\r1,2\r", "\n\ntime,x\n0,1\n1,2\n", "time,x\n0,1\n1,2\n,\n"]
)
def test_what_is_not_plain_is_read_all_the_same(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text, newline="")
    assert read_columns(path)["time"].tolist() == [0.0, 1.0]
    assert read_results(path).time.tolist() == [0.0, 1.0]


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
    csv, other = tmp_path / "r.csv", tmp_path / f"r{suffix}"
    for path in (csv, other):
        written.write(path)
    read, same = (read_results(path, {"a.x": "m"}, tuple(exact)) for path in (csv, other))
    assert read.values.tobytes() == same.values.tobytes() == values.tobytes()
    assert (read.columns, read.units, read.exact, read.whole) == (same.columns, same.units, same.exact, same.whole)


def test_csv_has_the_shortest_digits_that_read_back_as_the_same_number(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    sizes = 10.0 ** rng.integers(-7, 19, 20_000) * rng.uniform(-1.0, 1.0, 20_000)
    limits = np.nextafter([1e-4, 1e-4, 1e-5, 1e15, 1e16, 1e16, 1e17], [0.0, 1.0, 0.0, 0.0, 0.0, 1e17, 0.0])
    special = [0.0, -0.0, math.nan, math.inf, -math.inf, 5e-324, 1e-4, 1e-5, 1e16, 1e22, 2.0**53, 0.1 + 0.2, 1 / 3]
    values = np.concatenate((rng.integers(0, 2**64, 20_000, dtype=np.uint64).view(np.float64), sizes, limits, special))
    counts = rng.integers(-(2**62), 2**62, values.size)
    path = tmp_path / "r.csv"
    source_named(".csv").write(path, [Column("time", "s", values), Column("n", "", counts)])
    rows = zip(values.tolist(), counts.tolist(), strict=True)
    assert path.read_bytes().decode() == "time,n\n" + "".join(f"{t!r},{n!r}\n" for t, n in rows)


@pytest.mark.parametrize(
    ("columns", "told"),
    [
        ({"x": [1.0, 0.0, 2.0, 3.0, 4.0]}, 'the first column is "x"; it must be "time"'),
        ({"time": TIME, "x": [[1.0], [2.0], [], [3.0], [4.0]]}, "column x has the type list"),
        ({"time": TIME, "x": list("abcde")}, "column x has text"),
        ({"time": [0.0, None, 1.0, 1.5, 2.0], "x": TIME}, ":2:1: "),
        ({"time": [0.0, 1.0, 0.9, 1.5, 2.0], "x": TIME}, ":3:1: "),
        ({"time": TIME, "x": [1.0, math.inf, 2.0, 3.0, 4.0]}, ":2:2: "),
        ({"time": [], "x": []}, "has no rows"),
        ({}, "has no columns"),
    ],
)  # fmt: skip
def test_a_fault_of_a_parquet_file_has_its_place(tmp_path: Path, columns: dict[str, Any], told: str) -> None:
    assert told in "\n".join(faults_of(parquet(tmp_path / "a.parquet", columns)))


def test_a_torn_file_is_one_message(tmp_path: Path) -> None:
    torn = parquet(tmp_path / "torn.parquet", {"time": np.arange(500.0), "x": np.arange(500.0) ** 2})
    whole = torn.read_bytes()
    middle = len(whole) // 2
    for part in (b"", whole[:8], whole[:middle], whole[:-1], whole[:middle] + whole[-200:]):
        torn.write_bytes(part)
        assert len(faults_of(torn)) == 1


# -- verbs --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("format_", "words"), [("xls", r"CSV \(.csv\), Parquet \(.parquet\)"), ("hdf5", r"pip install 'fmu-cosim\[hdf5\]'")]
)
def test_a_format_that_cannot_be_written_is_told_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, format_: str, words: str
) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    content = {
        "name": "s",
        "duration": 1,
        "step": 0.1,
        "components": {"r": {"block": "reference", "signals": {"x": {}}}},
    }
    with pytest.raises(InputError, match=words):
        cosim.run(content, tmp_path / "out", format=format_)
    assert not (tmp_path / "out").exists()


# -- formats of other tools --------------------------------------------------------------------------------


def test_mat_and_hdf5_are_read_by_other_tools(tmp_path: Path) -> None:
    h5py, results = pytest.importorskip("h5py"), Results(TIME, ("tank.level",), TIME[:, np.newaxis] ** 2)
    for suffix in (".mat", ".h5"):
        results.write(tmp_path / f"r{suffix}")
    assert loadmat(tmp_path / "r.mat")["values"][:, 0].tolist() == (TIME**2).tolist()
    with h5py.File(tmp_path / "r.h5") as file:
        assert file["tank/level"][:].tolist() == (TIME**2).tolist()


@pytest.mark.parametrize("suffix", ["mat", "h5"])
def test_variables_of_other_tools_become_columns(tmp_path: Path, suffix: str) -> None:
    """A temperature is no time; units and large numbers are kept; what has another length is no column."""
    path = tmp_path / f"a.{suffix}"
    content = {"T": TIME + 300.0, "t [ms]": 1e3 * TIME, "n": np.array([2**64 - 1, 1, 2, 3, 4], dtype=np.uint64)}
    if suffix == "mat":
        savemat(path, content | {"gain": 3.0, "note": "text"})
    else:
        with pytest.importorskip("h5py").File(path, "w") as file:
            for name, values in content.items():
                file[name] = values
            file["short"] = [1.0]
    read = read_columns(path)
    assert read["time"].tolist() == TIME.tolist()
    columns = {name: read[name].tolist() for name in read.by_name if name != "time"}
    assert columns == {"T": (TIME + 300.0).tolist(), "n": [2.0**64, 1, 2, 3, 4]}


@pytest.mark.parametrize(
    ("names", "index", "read"),
    [
        ("x T", ["time [ms]"], "x T"),
        ("T time", [], "T"),
        ("x time", ["T"], "x T"),
        ("x", ["run", "time"], "x run"),
    ],
)
def test_the_index_of_a_pandas_table_is_its_time(tmp_path: Path, names: str, index: list[str], read: str) -> None:
    pandas, path = pytest.importorskip("pandas"), tmp_path / "a.parquet"
    values = {"time": TIME, "time [ms]": 1e3 * TIME, "x": TIME + 1.0, "T": TIME + 300.0, "run": [1, 1, 1, 2, 2]}
    frame = pandas.DataFrame({name: values[name] for name in names.split() + index})
    (frame.set_index(index) if index else frame[TIME >= 0.5]).to_parquet(path)  # rows of a longer table
    assert read_results(path).time.tolist() == (TIME if index else TIME[1:]).tolist()
    assert [*read_columns(path).by_name] == ["time", *read.split()] == read_header(path)
