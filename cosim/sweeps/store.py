"""Where runs are kept: one by one in a database while a sweep lasts, in one Parquet file when it has ended."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from cosim.arrays import Array
from cosim.errors import Fault, InputError
from cosim.sweeps.runs import Made
from fmus.files import draft_of

if TYPE_CHECKING:
    import pyarrow

DATABASE, TABLE = "runs.sqlite", "sweep.parquet"
MADE, CHECKED = "made", "checked"
COLUMNS = "run INTEGER PRIMARY KEY, status TEXT, through TEXT, figures BLOB, met BLOB, signals BLOB, rows INTEGER"


class Database:
    """Context: runs made so far, whole or not at all, also where the process is killed."""

    def __init__(self, folder: Path, key: str) -> None:
        self.path = folder / DATABASE
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
        """What was kept under a name."""
        row = self._base.execute("SELECT content FROM sweep WHERE key = ?", (name,)).fetchone()
        return None if row is None else str(row[0])

    def put(self, name: str, content: str) -> None:
        """Keep a text under a name."""
        with self._base:
            self._base.execute("DELETE FROM sweep WHERE key = ?", (name,))
            self._base.execute("INSERT INTO sweep VALUES (?, ?)", (name, content))

    def add(self, runs: Iterable[Made], table: str = MADE) -> None:
        """Keep runs, all of them or none."""
        rows = [
            (m.run, m.status, m.through, np.array(m.values).tobytes(), np.array(m.met, bool).tobytes(),
             m.signals.tobytes(), len(m.signals))
            for m in runs
        ]  # fmt: skip
        with self._base:
            self._base.executemany(f"INSERT INTO {table} VALUES (?, ?, ?, ?, ?, ?, ?)", rows)

    def there(self, table: str = MADE) -> set[int]:
        """Numbers of the runs that are kept."""
        return {run for (run,) in self._base.execute(f"SELECT run FROM {table}")}

    def runs(self, table: str = MADE) -> list[Made]:
        """All of them, in order."""
        found = []
        for run, status, through, figures, met, signals, rows in self._base.execute(
            f"SELECT * FROM {table} ORDER BY run"
        ):
            shaped = np.frombuffer(signals).reshape(rows, -1) if rows else np.empty((0, 0))
            values = tuple(np.frombuffer(figures).tolist())
            found.append(Made(run, status, values, tuple(np.frombuffer(met, bool).tolist()), shaped, through))
        return found

    def clear(self) -> None:
        """Forget the runs: they are made again another way."""
        with self._base:
            self._base.execute(f"DELETE FROM {MADE}")

    def remove(self) -> None:
        """Close it and take it away."""
        self._base.close()
        self.path.unlink(missing_ok=True)


def write_table(
    path: Path, runs: Sequence[Made], design: Mapping[str, Sequence[Any]], criteria: Sequence[str],
    signals: Sequence[str], about: Mapping[str, Any],
) -> None:  # fmt: skip
    """One row a run: its number, what varied, how it went, each criterion's value and whether it is met, each signal.

    A signal is a list of values at the times that stand in the metadata, as JSON under `cosim`.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns: dict[str, Any] = {"run": pa.array([m.run for m in runs], pa.int64())}
    for name, values in design.items():
        columns[name] = pa.array([values[m.run] for m in runs])
    columns["status"] = pa.array([m.status for m in runs])
    columns["through"] = pa.array([m.through for m in runs])
    for k, name in enumerate(criteria):
        columns[name] = pa.array([_number(m.values[k]) if m.status == "ok" else None for m in runs], pa.float64())
        columns[f"{name} met"] = pa.array([m.met[k] if m.status == "ok" else None for m in runs], pa.bool_())
    for k, name in enumerate(signals):
        lists = [m.signals[k] if m.status == "ok" else None for m in runs]
        columns[name] = pa.array(lists, pa.list_(pa.float64()))
    table = pa.table(columns).replace_schema_metadata({"cosim": json.dumps(about)})
    with draft_of(path) as draft:
        pq.write_table(table, draft, compression="zstd")


def _number(value: float) -> float | None:
    return None if np.isnan(value) else value


def read_table(path: Path) -> tuple[pyarrow.Table, dict[str, Any]]:
    """The table that a sweep left, and what stands in its metadata. Raises OSError, ValueError."""
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    return table, json.loads((table.schema.metadata or {}).get(b"cosim", b"{}"))


def signal_of(table: pyarrow.Table, name: str) -> Array:
    """A signal of every run that has it, shape (runs, times)."""
    column = table.column(name).drop_null()
    return np.array(column.to_pylist(), dtype=float) if len(column) else np.empty((0, 0))
