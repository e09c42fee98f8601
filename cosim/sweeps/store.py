"""Storage of runs: a database during a sweep, a Parquet file afterwards."""

from __future__ import annotations

import errno
import itertools
import json
import os
import sqlite3
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from cosim.base.arrays import Array
from cosim.base.drafts import draft_of
from cosim.base.errors import InputError
from cosim.base.extras import optional
from cosim.base.messages import Message, code_of
from cosim.storage.files import open_bytes
from cosim.sweeps.run_chunks import RunResult

if TYPE_CHECKING:
    import pyarrow

DATABASE, TABLE = "runs.sqlite", "sweep.parquet"
TABLE_USE = "the table of a sweep"
GROUP = 4096  # runs per write
RUNS, CHECKS = "made", "checked"
COLUMNS = "run INTEGER PRIMARY KEY, status TEXT, through TEXT, figures BLOB, met BLOB, signals BLOB, rows INTEGER"


class Database:
    """Database of finished runs, consistent even after a kill; a context manager."""

    def __init__(self, folder: Path, key: str) -> None:
        self.path = folder / DATABASE
        if os.path.lexists(self.path) and not stat.S_ISREG(self.path.lstat().st_mode):
            raise InputError.at(self.path, "is no file of a sweep; move it away, or give another --out")
        try:
            self._base = sqlite3.connect(self.path)
            self._base.execute("PRAGMA synchronous = NORMAL")
            with self._transaction():
                for table in (RUNS, CHECKS):
                    self._base.execute(f"CREATE TABLE IF NOT EXISTS {table} ({COLUMNS})")
                self._base.execute("CREATE TABLE IF NOT EXISTS sweep (key TEXT, content TEXT)")
            stored = self.get("key")
        except sqlite3.Error as error:
            raise InputError.at(self.path, f"is no database of a sweep: {error!s}; --force begins anew") from None
        if stored not in {None, key}:
            self._base.close()
            raise InputError.at(
                self.path, "holds the runs of another sweep; give another folder as --out, or begin anew by --force"
            )
        self.put("key", key)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._base.close()

    def get(self, name: str) -> str | None:
        """Return the text stored under a name, if any."""
        row = self._base.execute("SELECT content FROM sweep WHERE key = ?", (name,)).fetchone()
        return None if row is None else str(row[0])

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        """Store all changes of a block or none; raise OSError for a disk without space."""
        try:
            with self._base:
                yield
        except sqlite3.Error as error:
            if error.sqlite_errorcode & 0xFF not in {sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR}:  # also beyond a quota
                raise
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path)) from None

    def put(self, name: str, content: str) -> None:
        """Store a text under a name."""
        with self._transaction():
            self._base.execute("DELETE FROM sweep WHERE key = ?", (name,))
            self._base.execute("INSERT INTO sweep VALUES (?, ?)", (name, content))

    def add(self, runs: Iterable[RunResult], table: str = RUNS) -> None:
        """Store runs, all or none."""
        rows = []
        for m in runs:
            blobs = (np.array(m.values).tobytes(), np.array(m.met, bool).tobytes(), m.signals.tobytes())
            status = f"{m.status}\t{code_of(m.status)}"  # a status has no tab
            rows.append((m.run, status, m.through, *blobs, len(m.signals)))
        with self._transaction():
            self._base.executemany(f"INSERT INTO {table} VALUES (?, ?, ?, ?, ?, ?, ?)", rows)

    def numbers(self, table: str = RUNS) -> set[int]:
        """Return the numbers of the stored runs."""
        return {run for (run,) in self._base.execute(f"SELECT run FROM {table}")}

    def runs(self, table: str = RUNS) -> Iterator[RunResult]:
        """Yield the results of all runs in order, without loading them into memory at once."""
        rows = self._base.execute(f"SELECT * FROM {table} ORDER BY run")
        for run, stored, through, figures, met, signals, count in rows:
            shaped = np.frombuffer(signals).reshape(count, -1) if count else np.empty((0, 0))
            values, goals = tuple(np.frombuffer(figures).tolist()), tuple(np.frombuffer(met, bool).tolist())
            status, _, code = stored.partition("\t")
            yield RunResult(run, Message(status, code), values, goals, shaped, through)

    def remove(self) -> None:
        """Close and delete the database."""
        self._base.close()
        self.path.unlink(missing_ok=True)


def write_table(
    path: Path,
    runs: Iterable[RunResult],
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
    design = {name: _of_one_type(values) for name, values in design.items()}
    types: dict[str, Any] = {"run": pa.int64(), **{name: pa.array(values).type for name, values in design.items()}}
    types |= {"status": pa.string(), "through": pa.string()}
    for name in criteria:
        types |= {name: pa.float64(), f"{name} met": pa.bool_()}
    types |= {name: pa.list_(pa.float64()) for name in signals}
    schema = pa.schema(list(types.items()), {"cosim": json.dumps(about)})

    def row(m: RunResult) -> dict[str, Any]:
        cells: dict[str, Any] = {"run": m.run, **{name: values[m.run] for name, values in design.items()}}
        cells |= {"status": m.status, "through": m.through}
        if m.status == "ok":
            for name, value, is_met in zip(criteria, m.values, m.met, strict=True):
                cells |= {name: None if np.isnan(value) else value, f"{name} met": is_met}
            cells |= zip(signals, m.signals, strict=True)
        return cells

    remaining = iter(runs)
    with draft_of(path) as draft, pq.ParquetWriter(draft, schema, compression="zstd") as writer:
        while part := list(itertools.islice(remaining, GROUP)):
            writer.write_table(pa.Table.from_pylist([row(m) for m in part], schema=schema))


def _of_one_type(values: Sequence[Any]) -> list[Any]:
    """Return values of a single type for a column.

    Integers mixed with floats become floats; lists and mixtures become text.
    """
    kinds = {type(v) for v in values}
    if len(kinds) == 1 and list not in kinds:
        return list(values)
    return [float(v) for v in values] if kinds == {int, float} else [json.dumps(v) for v in values]


def read_table(path: Path) -> tuple[pyarrow.Table, dict[str, Any]]:
    """Return the table of a sweep and its metadata.

    Raises:
        OSError: The file is unreadable; ValueError for a damaged file.
    """
    with open_bytes(path) as stream:
        table = optional("pyarrow.parquet", TABLE_USE).read_table(stream)
    return table, json.loads((table.schema.metadata or {}).get(b"cosim", b"{}"))


def signal_of(table: pyarrow.Table, name: str, most: int | None = None) -> Array:
    """Return a signal of successful runs, shape (runs, times).

    Args:
        most: Largest number of runs, evenly spread; None for all.
    """
    column = table.column(name).drop_null()
    if most is not None and len(column) > most:
        column = column.take(np.linspace(0, len(column) - 1, most).astype(int))
    return np.array(column.to_pylist(), dtype=float) if len(column) else np.empty((0, 0))
