"""Results of `run` and `simulate`, in files or in memory: signals by name, data frames, figures and text."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.core.arrays import Array
from cosim.core.errors import InputError
from cosim.core.extras import pandas_for_frames
from cosim.core.messages import Note, printable
from cosim.core.text import MISSING, counted, did_you_mean, plain
from cosim.files.artefact import LOG, folder_kind
from cosim.files.folders import manifest_in, newest_run, replay_record, run_name, status_in, warnings_on
from cosim.files.kinds import check_given, refuse_folder
from cosim.files.results import Results, read_results, rows_in
from cosim.files.table import as_text, suffixes

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure


MAX_LINES = 8  # signals in the short text; further signals are counted only
LONGEST_TEXT = 40  # characters of a value in a table
RUN_OR_TABLE = "the folder of a run or a table of its rows"


@dataclass(frozen=True)
class Chart:
    """An interactive chart that a notebook displays; `html` is its content."""

    html: str = field(repr=False)

    def _repr_html_(self) -> str:
        return self.html


@dataclass(frozen=True, repr=False)
class Signals:
    """Rows of a run; `signals["plant.x"]` is one column.

    Attributes:
        title: Name of the run.
        folder: Folder with the files of the run; None if no files were written.
    """

    title: str
    results: Results
    folder: Path | None = None

    @property
    def time(self) -> Array:
        """Return the communication points [s]."""
        return self.results.time

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the numeric signals, `component.variable`."""
        return self.results.columns

    @property
    def units(self) -> Mapping[str, str]:
        """Return signal → unit, "" without unit."""
        return self.results.units

    def __len__(self) -> int:
        return len(self.results.time)

    def __contains__(self, name: object) -> bool:
        return name in self.results.columns or name in self.results.exact

    def __getitem__(self, name: str) -> Array:
        if name not in self.results.columns:
            hint = did_you_mean(name, self.results.columns)
            raise KeyError(f'no signal "{name}"{hint}')
        return self.results[name]

    def _ipython_key_completions_(self) -> list[str]:
        return [*self.names]

    def to_pandas(self) -> pandas.DataFrame:
        """Return a data frame of all signals with the time [s] as index; raise ImportError without pandas."""
        library = pandas_for_frames()
        index = library.Index(self.time, name="time")
        frame: pandas.DataFrame = library.DataFrame(
            self.results.values, index=index, columns=list(self.results.columns)
        )
        for name, column in self.results.exact.items():
            frame[name] = list(column)
        frame.attrs["units"] = dict(self.results.units)
        return frame

    def plot(self, *names: str) -> Figure:
        """Return a matplotlib figure of the named signals (default: the first ones); signals of one unit share axes."""
        for name in names:
            self[name]  # raises KeyError for an unknown name
        from cosim.simulation.report.figures import sheet
        from cosim.simulation.report.run_page import drawable_run, signal_panels

        hidden = frozenset(self.results.columns) - set(names) if names else frozenset[str]()
        run = drawable_run(self.results, {})
        return sheet(run.time, signal_panels(run, hidden))

    def chart(self, *names: str) -> Chart:
        """Return an interactive chart for a notebook, by default of the first signals.

        Raises:
            KeyError: There is no such signal.
        """
        from cosim.simulation.report.run_page import results_cell

        shown = self.results.with_integers()
        for name in names:
            if name not in shown:
                self[name]
        return Chart(results_cell(shown, names or shown.columns, self.title))

    def __repr__(self) -> str:
        lines = [f"  {n} [{self.units.get(n) or '1'}] {' → '.join(self._ends(n))}" for n in self.names[:MAX_LINES]]
        more = [f"  … and {len(self.names) - MAX_LINES} more"] if len(self.names) > MAX_LINES else []
        return "\n".join([self._heading(), *lines, *more, *(f"  {line}" for line in self._sentences)])

    def _heading(self) -> str:
        end = f", {plain(float(self.time[0]))} … {plain(float(self.time[-1]))} s" if len(self) else ""
        return f"{self.title}: {counted(len(self.names), 'signal')}, {counted(len(self), 'row')}{end}"

    def _ends(self, name: str) -> tuple[str, str]:
        """Return the first and the last value of a signal as texts."""
        exact = self.results.exact.get(name)
        values = self.results[name] if exact is None else exact
        if not len(values):
            return MISSING, MISSING
        first, last = (plain(float(v)) if exact is None else as_text(v) for v in (values[0], values[-1]))
        first, last = (text if len(text) <= LONGEST_TEXT else f"{text[:LONGEST_TEXT]}…" for text in (first, last))
        return first, last

    def _repr_html_(self) -> str:
        from html import escape

        from cosim.core.notebook import heading, table

        texts = [*self.results.exact]
        shown = [*self.names[: 2 * MAX_LINES], *texts[:MAX_LINES]]
        rows = [(name, self.units.get(name, ""), *self._ends(name)) for name in shown]
        signals = table(("signal", "unit", "first", "last"), rows, len(self.names) + len(texts) - len(rows))
        if chart := self.chart().html:
            signals = f"<details><summary>Signals</summary>{signals}</details>"
        lines = "".join(f"<li>{escape(line)}</li>" for line in self._sentences)
        return heading(self._heading()) + (f"<ul>{lines}</ul>" if lines else "") + chart + signals

    @property
    def _sentences(self) -> list[str]:
        """Return sentences on the outcome of the run."""
        return []


@dataclass(frozen=True, repr=False)
class Run(Signals):
    """Signals of a run with its manifest, criteria and warnings."""

    manifest: Mapping[str, Any] = field(default_factory=dict)

    @property
    def criteria(self) -> list[dict[str, Any]]:
        """Return the criteria of the run, each with value, limit and outcome."""
        return list(self.manifest.get("criteria") or ())

    @property
    def missed(self) -> list[dict[str, Any]]:
        """Return the criteria that the run missed."""
        return [c for c in self.criteria if not c["met"]]

    @property
    def warnings(self) -> list[str]:
        """Return the warnings of the run."""
        return list(self.manifest.get("warnings") or ())

    @property
    def report(self) -> Path | None:
        """Return the path of report.html; None if it was not written."""
        page = None if self.folder is None else self.folder / "report.html"
        return page if page is not None and page.is_file() else None

    @property
    def _sentences(self) -> list[str]:
        from cosim.simulation.criteria import sentence

        return [*self.validity, *(sentence(c) for c in self.criteria)]

    @property
    def validity(self) -> list[str]:
        """Return a sentence on the time within the logs, for each FMU with a record of credibility."""
        from cosim.credibility.validity import validity_sentence

        entries = self.manifest.get("validity") or {}
        return [text for name, entry in entries.items() if (text := validity_sentence(name, entry))]


def run_of(results: Results, manifest: Mapping[str, Any], folder: Path | None) -> Run:
    """Return a run with the name of its scenario."""
    name = manifest.get("scenario", {}).get("name") or (folder.name if folder else "run")
    return Run(name, results, folder, manifest)


def read_run(path: Path) -> Run | Signals:
    """Return the run in a folder, or the signals in a table; raise InputError if there are none."""
    ran = read_ran(path)
    for text in (t for t in ran.warnings if not isinstance(t, Note)):
        warnings.warn(printable(text), stacklevel=2)
    return run_of(ran.results, ran.manifest, ran.path) if path.is_dir() else Signals(ran.name, ran.results)


@dataclass(frozen=True)
class RecordedRun:
    """Results read from files, with path and name, warnings about the files, and the manifest if there is one."""

    path: Path
    name: str
    results: Results
    manifest: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def criteria(self) -> list[dict[str, Any]]:
        """Return the evaluated criteria in the manifest."""
        return list(self.manifest.get("criteria", ()))


def read_ran(path: Path) -> RecordedRun:
    """Return the results at a path; raise InputError if there are none, also if they have just been removed."""
    try:
        path = newest_run(path)
        if not path.exists():
            raise InputError.at(path, f"no such folder or file; give {RUN_OR_TABLE}")
        if not path.is_dir():
            check_given(path, LOG)
            results = read_results(path)
            return RecordedRun(path, path.stem, results, {}, tuple(map(Note, results.notes)))
        rows = rows_in(path)
        if rows is None:
            kind = folder_kind(path)
            if kind is None or "results" not in kind.tables:
                refuse_folder(path, RUN_OR_TABLE)
            names = " or ".join(f"results{suffix}" for suffix in suffixes())
            raise InputError.at(
                path, f"this folder has no {names}{status_in(path)}; give another run, or a table of its rows"
            )
        manifest = manifest_in(path)
        units: Any = manifest.get("units") or replay_record(path).get("units") or {}
        results = read_results(rows, units, manifest.get("beside", ()), words=manifest.get("texts", ()))
        return RecordedRun(path, run_name(path), results, manifest, tuple(warnings_on(path)))
    except FileNotFoundError:
        raise InputError.at(
            path, "was removed while it was read; repeat the command with the remaining results"
        ) from None
