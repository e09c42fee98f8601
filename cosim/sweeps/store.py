"""Storage of runs: a database during a sweep, a Parquet file after it."""

from __future__ import annotations

import errno
import itertools
import json
import os
import sqlite3
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.core.arrays import Array
from cosim.core.drafts import draft_of
from cosim.core.errors import InputError
from cosim.core.extras import pandas_for_frames
from cosim.core.text import counted, display, join_names, showing
from cosim.files.files import open_bytes
from cosim.files.folders import content_of
from cosim.sweeps.runs import RunResult

if TYPE_CHECKING:
    import pandas
    import pyarrow
    from matplotlib.figure import Figure

DATABASE, SWEEP_TABLE, SWEEP_RECORD = "runs.sqlite", "sweep.parquet", "sweep.json"
RUNS_PER_WRITE = 4096  # runs per write
STORED_EVERY = 0.2  # [s]
DATABASE_VERSION = 3  # of the database; one of another format is not continued


class Database:
    """Database of finished runs, consistent even after a kill, which only loses runs of the last moment."""

    def __init__(self, path: Path, key: str) -> None:
        self.path, key = path, f"{DATABASE_VERSION} {key}"
        try:
            self._base = sqlite3.connect(path)
            self._stored = time.monotonic()
            self._base.execute("PRAGMA synchronous = NORMAL")
            with self._full_disk_as_oserror(), self._base:
                self._base.execute("CREATE TABLE IF NOT EXISTS made (run INTEGER PRIMARY KEY, result BLOB)")
                self._base.execute("CREATE TABLE IF NOT EXISTS sweep (key TEXT)")
                stored = self._base.execute("SELECT key FROM sweep").fetchone()
                if stored is None:
                    self._base.execute("INSERT INTO sweep VALUES (?)", (key,))
        except sqlite3.Error as error:
            raise InputError.at(path, f"is not a database of a sweep: {error}; use --force to start again") from None
        if stored not in {None, (key,)}:
            self._base.close()
            cure = "give another folder as --out, or use --force to start again"
            raise InputError.at(path, f"has the runs of another sweep, or of other FMUs; {cure}")

    @contextmanager
    def _full_disk_as_oserror(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            code = getattr(error, "sqlite_errorcode", 0) & 0xFF
            if code not in {sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR}:  # also beyond a quota
                raise
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path)) from None

    def add(self, run: RunResult) -> None:
        """Add a run, replacing an earlier one with the same number; runs are collected and stored after a moment."""
        with self._full_disk_as_oserror():
            about = json.dumps([run.run, run.status, [*run.values], [*run.met], run.signals.shape, run.valid])
            content = about.encode() + b"\n" + run.signals.tobytes()
            self._base.execute("INSERT OR REPLACE INTO made VALUES (?, ?)", (run.run, content))
        if time.monotonic() - self._stored > STORED_EVERY:
            self.store()

    def store(self) -> None:
        """Store all added runs or none; raise OSError if the disk is full."""
        self._stored = time.monotonic()
        with self._full_disk_as_oserror(), self._base:
            pass

    def close(self) -> None:
        """Store the added runs if the disk has space, and close the database."""
        with suppress(OSError, sqlite3.ProgrammingError):  # the database may be closed already
            self.store()
        self._base.close()

    def numbers(self) -> set[int]:
        """Return the numbers of the stored runs."""
        return {run for (run,) in self._base.execute("SELECT run FROM made")}

    def runs(self) -> Iterator[RunResult]:
        """Yield the results of all runs in order, without loading them into memory at once."""
        for (content,) in self._base.execute("SELECT result FROM made ORDER BY run"):
            about, _, samples = content.partition(b"\n")
            run, status, values, met, shape, valid = json.loads(about)
            yield RunResult(run, status, values, met, np.frombuffer(samples).reshape(shape), valid)

    def remove(self) -> None:
        """Close and delete the database; for a part of a sweep, also its folder."""
        self._base.close()
        self.path.unlink(missing_ok=True)
        with suppress(OSError):  # the folder of the sweep is not empty
            self.path.parent.rmdir()
            self.path.parent.parent.rmdir()


def write_table(
    path: Path,
    runs: Iterable[RunResult],
    design: Mapping[str, Sequence[Any]],
    criteria: Sequence[str],
    signals: Sequence[str],
    about: Mapping[str, Any],
) -> None:
    """Write a Parquet table with a row per run.

    Columns are number, factors, status, values and outcomes of the criteria, and signals. A signal is a list of values;
    its times are in the metadata, as JSON under `cosim`.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    types_of = {bool: pa.bool_(), int: pa.int64(), float: pa.float64(), str: pa.string()}
    table: dict[str, list[Any]] = {}  # columns of a single type: integers mixed with floats become floats
    for name, values in design.items():
        kinds = {type(v) for v in values}
        if len(kinds) == 1 and kinds <= types_of.keys():
            table[name] = list(values)
        else:  # lists and mixtures become text
            table[name] = [float(v) if kinds == {int, float} else json.dumps(v) for v in values]
    types: dict[str, Any] = {"run": pa.int64(), **{name: types_of[type(of[0])] for name, of in table.items()}}
    types["status"] = pa.string()
    for name in criteria:
        types |= {name: pa.float64(), f"{name} met": pa.bool_()}
    types |= {name: pa.list_(pa.float64()) for name in signals}
    schema = pa.schema(list(types.items()), {"cosim": json.dumps(about)})

    remaining = iter(runs)
    with draft_of(path) as draft, pq.ParquetWriter(draft, schema, compression="zstd") as writer:
        while part := list(itertools.islice(remaining, RUNS_PER_WRITE)):
            columns: dict[str, Any] = {name: [values[m.run] for m in part] for name, values in table.items()}
            columns |= {"run": [m.run for m in part], "status": [m.status for m in part]}
            for k, name in enumerate(criteria):
                judged = (m.values[k] if m.status == "ok" else np.nan for m in part)
                columns[name] = [None if np.isnan(value) else value for value in judged]
                columns[f"{name} met"] = [m.met[k] if m.status == "ok" else None for m in part]
            for k, name in enumerate(signals):
                columns[name] = [m.signals[k] if m.status == "ok" else None for m in part]
            arrays = [_column(kind, columns[name]) for name, kind in types.items()]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))


def _column(kind: Any, values: Sequence[Any]) -> Any:
    """Return a column of a type, in which None is a missing value.

    `pyarrow.array` would import pandas where it is installed, which takes longer than many a sweep.
    """
    import pyarrow as pa

    def packed(flags: Any) -> Any:
        return pa.py_buffer(np.packbits(flags, bitorder="little"))

    count, is_there, children = len(values), np.array([value is not None for value in values]), list[Any]()
    if kind in (pa.string(), pa.list_(pa.float64())):
        contents = [b"" if v is None else v.encode() if isinstance(v, str) else v.tobytes() for v in values]
        size, joined = 1 if kind == pa.string() else 8, pa.py_buffer(b"".join(contents))
        ends = np.cumsum([0, *(len(content) // size for content in contents)], dtype=np.int32)
        buffers = [pa.py_buffer(ends), joined]
        if size == 8:
            children.append(pa.Array.from_buffers(pa.float64(), int(ends[-1]), [None, buffers.pop()]))
    else:
        data = np.array([0 if v is None else v for v in values], kind.to_pandas_dtype())
        buffers = [packed(data) if kind == pa.bool_() else pa.py_buffer(data)]
    return pa.Array.from_buffers(kind, count, [packed(is_there), *buffers], children=children)


def read_table(path: Path) -> tuple[pyarrow.Table, dict[str, Any]]:
    """Return the table of a sweep and its metadata.

    Raises:
        OSError: The file is unreadable. ValueError: The file is damaged.
    """
    import pyarrow.parquet as pq

    with open_bytes(path) as stream:
        table = pq.read_table(stream)
    return table, json.loads((table.schema.metadata or {}).get(b"cosim", b"{}"))


def signal_of(table: pyarrow.Table, name: str, most: int | None = None) -> Array:
    """Return a signal of successful runs, shape (runs, times).

    Args:
        most: Largest number of runs, which are then evenly spaced; None for all.
    """
    column = table.column(name).drop_null()
    if most is not None and len(column) > most:
        column = column.take(np.linspace(0, len(column) - 1, most).astype(int))
    return np.array(column.to_pylist(), dtype=float) if len(column) else np.empty((0, 0))


@dataclass(frozen=True, repr=False)
class Runs:
    """The runs of a sweep.

    Attributes:
        record: Content of sweep.json.
        folder: Folder with sweep.parquet.
    """

    record: Mapping[str, Any]
    folder: Path

    @property
    def headline(self) -> str:
        """Return a sentence with the number of runs that meet all criteria, and the criterion that most runs miss."""
        record = self.record
        criteria, runs, completed = record["criteria"], record["runs"], record["runs"] - record["failed"]
        if not criteria:
            return f"{completed} of {counted(runs, 'run')} completed; the scenario sets no criteria."
        met, fewest = record["met_all"], hardest(record)["met"]
        all_of = "the criterion" if len(criteria) == 1 else "all criteria"
        worst = [c["name"] for c in criteria if c["met"] == fewest < c["of"]]
        most = f"; {counted(completed - fewest, 'run')} missed {join_names(worst)}"
        most = most if 0 < len(worst) < len(criteria) else ""
        return f"{met} of {counted(runs, 'run')} {'meets' if met == 1 else 'meet'} {all_of}{most}."

    @property
    def criteria(self) -> dict[str, Array]:
        """Return the values of each criterion in the runs, NaN without one."""
        table, _ = read_table(self.folder / SWEEP_TABLE)
        names = [c["name"] for c in self.record["criteria"]]
        return {name: np.array(table.column(name).to_pylist(), float) for name in names}

    def signals(self, most: int) -> tuple[Array, dict[int, dict[str, Array]]]:
        """Return the sampled times [s] of the runs, and number of a run → its signals, of `most` completed runs."""
        table, about = read_table(self.folder / SWEEP_TABLE)
        completed = np.flatnonzero([status == "ok" for status in table.column("status").to_pylist()])
        spread = np.linspace(0, completed.size - 1, min(most, completed.size)).astype(int)
        rows = table.take(completed[spread]).to_pylist()
        names = about.get("signals", ())
        runs = {row["run"]: {name: np.array(row[name], float) for name in names} for row in rows if names}
        return np.array(about.get("times", ()), float), runs

    def plot(self) -> Figure:
        """Return a matplotlib figure with a histogram and the limit of each criterion."""
        from cosim.report.cell.cell import new_figure

        criteria, outcomes = self.record["criteria"], self.criteria
        figure = new_figure(5.6, 2.4 * max(1, len(criteria)))
        axes = figure.subplots(max(1, len(criteria)), squeeze=False).ravel()
        with showing(self.record):
            for ax, c in zip(axes, criteria, strict=False):
                unit, factor = display(c["unit"])
                values = outcomes[c["name"]] * factor
                ax.hist(values[np.isfinite(values)], bins="auto", color="#7fb8d8")
                ax.axvline(c["max"] * factor, color="#767676", linestyle="--")
                ax.set(xlabel=f"{c['name']} [{unit or '1'}]", ylabel="runs")
        return figure

    def _repr_html_(self) -> str:
        from cosim.core.notebook import heading, table
        from cosim.report.cell.cell import frame_of
        from cosim.report.charts import Charts
        from cosim.sweeps.report import histograms

        charts = Charts()
        with showing(self.record):
            plots = histograms(self.record["criteria"], self.criteria, charts)
        rows = [(c["name"], f"{c['met']} of {c['of']}") for c in self.record["criteria"]]
        name = str(self.record.get("name", "sweep"))
        text = heading(name, self.headline) + (table(("criterion", "met by"), rows) if rows else "")
        return text + (frame_of(charts, plots, name) if plots else "")

    def to_pandas(self) -> pandas.DataFrame:
        """Return one row per run: varied values, criteria, signals; raise ImportError without pandas."""
        pandas_for_frames()
        frame: pandas.DataFrame = read_table(self.folder / SWEEP_TABLE)[0].to_pandas()
        return frame

    def __repr__(self) -> str:
        runs = counted(int(self.record.get("runs") or 0), "run")
        return f"{self.record.get('name', 'sweep')}: {runs} in {self.folder}"


def hardest(record: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the criterion that the fewest runs meet."""
    criteria: list[Mapping[str, Any]] = record["criteria"]
    return min(criteria, key=lambda c: c["met"])


def read_runs(folder: Path) -> Runs | None:
    """Return a completed sweep's runs in a folder."""
    if not all((folder / name).is_file() for name in (SWEEP_RECORD, SWEEP_TABLE)):
        return None
    return Runs(content_of(folder / SWEEP_RECORD), folder)
