"""Results in the formats that PlotJuggler loads, read by the rules of its loaders (source of 2026-04, ddcbd05b).

Its loader of CSV splits each line by itself, and takes the type of a column from its first filled cell. Its loader of
Parquet takes columns by their Arrow type.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cosim.storage.results import Results

ROWS = 5
WORDS = ["idle", 'a, "b"', "", "run", "42"]
NUMBERS = {"tank.level": [1e-5, 0.5, -3e200, 1.25, 0.1 + 0.2], "valve.on": [1.0, 0.0, 1.0, 1.0, 0.0]}


@pytest.fixture
def results() -> Results:
    """Rows with doubles, integers of both sizes and texts."""
    values = np.array([*NUMBERS.values()]).T
    exact = {"tank.id": [2**53 + 1 + k for k in range(ROWS)], "tank.word": WORDS}
    whole = frozenset({"valve.on"})
    return Results(np.arange(ROWS) * 0.1, tuple(NUMBERS), values, {"tank.level": "m"}, exact, whole)


def _split_line(line: str) -> list[str]:
    """`SplitLine` of its CSV loader: a quoted cell is what lies between its last pair of quotes."""
    parts, quoted, word, start, first, last = list[str](), False, False, 0, 0, 0
    for place, character in enumerate(line):
        if character == '"':
            word, last = (True, place - 1) if quoted else (word, last)
            first = first if quoted else place + 1
            quoted = not quoted
        ends = place + 1 == len(line)
        if (not quoted and character == ",") or ends:
            end = place + 1 if ends and character != "," else place
            parts.append(line[first : last + 1].strip() if word else line[start:end].strip())
            start, word, quoted = place + 1, False, False
            if ends and character == ",":
                parts.append("")
    return parts


def _is_number(cell: str) -> bool:
    """`CheckNumeric` of its CSV loader: digits, one point, one exponent, signs."""
    mantissa, _, exponent = cell.lower().partition("e")
    digits = mantissa.removeprefix("-").replace(".", "", 1)
    return digits.isdecimal() and (not exponent or exponent.lstrip("+-").isdecimal())


def test_csv_is_split_into_columns_of_numbers_at_the_times(tmp_path: Path, results: Results) -> None:
    results.write(tmp_path / "results.csv")
    lines = (tmp_path / "results.csv").read_text().splitlines()
    names = _split_line(lines[0])
    assert names == ["time", "tank.level", "valve.on", "tank.id", "tank.word"]
    rows = [_split_line(line) for line in lines[1:]]
    assert {len(row) for row in rows} == {len(names)}
    first = {name: next(row[k] for row in rows if row[k]) for k, name in enumerate(names)}
    assert [name for name in names if _is_number(first[name])] == names[:-1]
    for k, name in enumerate(names[1:3], 1):
        assert [float(row[k]) for row in rows] == NUMBERS[name]
    assert [float(row[0]) for row in rows] == results.time.tolist()
    assert rows[0][4] == "idle"


def test_parquet_has_the_arrow_types_that_it_takes_as_numbers_and_texts(tmp_path: Path, results: Results) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    results.write(tmp_path / "results.parquet")
    file = parquet.ParquetFile(tmp_path / "results.parquet")
    kinds = {field.name: str(field.type) for field in file.schema_arrow}
    numbers = {"bool", "float", "double", *(f"{u}int{bits}" for u in ("", "u") for bits in (8, 16, 32, 64))}
    assert len(file.schema_arrow) == file.metadata.num_columns  # It takes fields of Arrow by the number of columns.
    assert {name for name, kind in kinds.items() if kind in numbers} == {"time", *NUMBERS, "tank.id"}
    assert {name for name, kind in kinds.items() if kind in {"string", "large_string", "binary"}} == {"tank.word"}
