"""Storage of runs: a database during a sweep, a Parquet file afterwards."""

from __future__ import annotations

import itertools
import json
import os
import sqlite3
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from cosim.base.arrays import Array
from cosim.base.drafts import draft_of
from cosim.base.errors import Fault, InputError
from cosim.base.extras import optional
from cosim.sweeps.run_chunks import Made

if TYPE_CHECKING:
    import pyarrow

DATABASE, TABLE = "runs.sqlite", "sweep.parquet"
TABLE_USE = "the table of a sweep"
GROUP = 4096  # runs per write
MADE, CHECKED = "made", "checked"
COLUMNS = "run INTEGER PRIMARY KEY, status TEXT, through TEXT, figures BLOB, met BLOB, signals BLOB, rows INTEGER"


class Database:
    """Database of finished runs, consistent even after a kill; a context manager."""

    def __init__(self, folder: Path, key: str) -> None:
        self.path = folder / DATABASE
        if os.path.lexists(self.path) and not stat.S_ISREG(self.path.lstat().st_mode):
            raise InputError([Fault(self.path, 0, 0, "is no file of a sweep; move it away, or give another --out")])
        try:
            self._base = sqlite3.connect(self.path)
            self._base.execute("PRAGMA synchronous = NORMAL")
            for table in (MADE, CHECKED):
                self._base.execute(f"CREATE TABLE IF NOT EXISTS {table} ({COLUMNS})")
            self._base.execute("CREATE TABLE IF NOT EXISTS sweep (key TEXT, content TEXT)")
            self._base.commit()
        except sqlite3.Error as error:
            raise InputError(
                [Fault(self.path, 0, 0, f"is no database of a sweep: {error}; --force begins anew")]
            ) from None
        before = self.get("key")
        if before is not None and before != key:
            self._base.close()
            message = "holds the runs of another sweep; give another folder as --out, or begin anew by --force"
            raise InputError([Fault(self.path, 0, 0, message)])
        self.put("key", key)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._base.close()

    def get(self, name: str) -> str | None:
        """Return the text stored under a name, if any."""
        row = self._base.execute("SELECT content FROM sweep WHERE key = ?", (name,)).fetchone()
        return None if row is None else str(row[0])

    def put(self, name: str, content: str) -> None:
        """Store a text under a name."""
        with self._base:
            self._base.execute("DELETE FROM sweep WHERE key = ?", (name,))
            self._base.execute("INSERT INTO sweep VALUES (?, ?)", (name, content))

    def add(self, runs: Iterable[Made], table: str = MADE) -> None:
        """Store runs, all or none."""
        rows = []
        for m in runs:
            blobs = (np.array(m.values).tobytes(), np.array(m.met, bool).tobytes(), m.signals.tobytes())
            rows.append((m.run, m.status, m.through, *blobs, len(m.signals)))
        with self._base:
            self._base.executemany(f"INSERT INTO {table} VALUES (?, ?, ?, ?, ?, ?, ?)", rows)

    def there(self, table: str = MADE) -> set[int]:
        """Return the numbers of the stored runs."""
        return {run for (run,) in self._base.execute(f"SELECT run FROM {table}")}

    def runs(self, table: str = MADE) -> Iterator[Made]:
        """Yield all runs in order, without loading them at once."""
        rows = self._base.execute(f"SELECT * FROM {table} ORDER BY run")
        for run, status, through, figures, met, signals, count in rows:
            shaped = np.frombuffer(signals).reshape(count, -1) if count else np.empty((0, 0))
            values = tuple(np.frombuffer(figures).tolist())
            yield Made(run, status, values, tuple(np.frombuffer(met, bool).tolist()), shaped, through)

    def remove(self) -> None:
        """Close and delete the database."""
        self._base.close()
        self.path.unlink(missing_ok=True)


def write_table(
    path: Path,
    runs: Iterable[Made],
    design: Mapping[str, Sequence[Any]],
    criteria: Sequence[str],
    signals: Sequence[str],
    about: Mapping[str, Any],
) -> None:
    """Write a table with a row per run.

    Columns are number, factors, status, values and outcomes of the criteria, and signals. A signal is a list of values;
    its times are in the metadata, as JSON under `cosim`.
    """
    pa, pq = optional("pyarrow", TABLE_USE), optional("pyarrow.parquet", TABLE_USE)
    types: dict[str, Any] = {"run": pa.int64()}
    design = {name: _of_one_type(values) for name, values in design.items()}
    types |= {name: pa.array(values).type for name, values in design.items()}
    types |= {"status": pa.string(), "through": pa.string()}
    for name in criteria:
        types |= {name: pa.float64(), f"{name} met": pa.bool_()}
    types |= {name: pa.list_(pa.float64()) for name in signals}
    schema = pa.schema(list(types.items()), {"cosim": json.dumps(about)})
    left = iter(runs)
    with draft_of(path) as draft, pq.ParquetWriter(draft, schema, compression="zstd") as writer:
        while part := list(itertools.islice(left, GROUP)):
            columns = _columns(part, design, criteria, signals)
            arrays = [pa.array(columns[name], kind) for name, kind in types.items()]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))


def _columns(
    runs: Sequence[Made], design: Mapping[str, Sequence[Any]], criteria: Sequence[str], signals: Sequence[str]
) -> dict[str, list[Any]]:
    """Return the values of some runs by column."""
    found: dict[str, list[Any]] = {name: [values[m.run] for m in runs] for name, values in design.items()}
    found |= {"run": [m.run for m in runs], "status": [m.status for m in runs], "through": [m.through for m in runs]}
    for k, name in enumerate(criteria):
        found[name] = [_number(m.values[k]) if m.status == "ok" else None for m in runs]
        found[f"{name} met"] = [m.met[k] if m.status == "ok" else None for m in runs]
    for k, name in enumerate(signals):
        found[name] = [m.signals[k] if m.status == "ok" else None for m in runs]
    return found


def _of_one_type(values: Sequence[Any]) -> list[Any]:
    """Return values of a single type for a column.

    Integers mixed with floats become floats; lists and mixtures become text.
    """
    kinds = {type(v) for v in values}
    if len(kinds) == 1 and list not in kinds:
        return list(values)
    return [float(v) for v in values] if kinds == {int, float} else [json.dumps(v) for v in values]


def _number(value: float) -> float | None:
    return None if np.isnan(value) else value


def read_table(path: Path) -> tuple[pyarrow.Table, dict[str, Any]]:
    """Return the table of a sweep and its metadata.

    Raises:
        OSError: The file is unreadable; ValueError for a damaged file.
    """
    pq = optional("pyarrow.parquet", TABLE_USE)
    table = pq.read_table(path)
    return table, json.loads((table.schema.metadata or {}).get(b"cosim", b"{}"))


def signal_of(table: pyarrow.Table, name: str, most: int | None = None) -> Array:
    """Return a signal of all successful runs, shape (runs, times).

    Args:
        most: Largest number of runs, evenly spread; None for all.
    """
    column = table.column(name).drop_null()
    if most is not None and len(column) > most:
        column = column.take(np.linspace(0, len(column) - 1, most).astype(int))
    return np.array(column.to_pylist(), dtype=float) if len(column) else np.empty((0, 0))
