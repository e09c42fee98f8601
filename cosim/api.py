"""The verbs for Python and notebooks, and what they return: signals by name, data frames, pictures, a short text."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.arrays import Array
from cosim.errors import Fault, InputError
from cosim.files import FilePath
from cosim.results import Results
from cosim.text import MISSING, counted, plain

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import pandas
    from matplotlib.figure import Figure

    from cosim.comparison.differences import Compared

SHOWN = 8  # signals in the short text of a run; further ones are counted


@dataclass(frozen=True, repr=False)
class Signals:
    """Rows of a run, `signals["plant.x"]` one column of them.

    title:   what it is of
    folder:  where files of it are, None where none were asked for
    """

    title: str
    results: Results
    folder: Path | None = None

    @property
    def time(self) -> Array:
        """Communication points [s]."""
        return self.results.time

    @property
    def names(self) -> tuple[str, ...]:
        """Signals that hold numbers, `component.variable`."""
        return self.results.columns

    @property
    def units(self) -> Mapping[str, str]:
        """Signal → unit, "" where it has none."""
        return self.results.units

    def __len__(self) -> int:
        return len(self.results.time)

    def __contains__(self, name: object) -> bool:
        return name in self.results.columns or name in self.results.exact

    def __getitem__(self, name: str) -> Array:
        if name not in self.results.columns:
            from cosim.yaml_file import did_you_mean

            raise KeyError(f'no signal "{name}"{did_you_mean(name, self.results.columns)}')
        return self.results[name]

    def to_pandas(self) -> pandas.DataFrame:
        """A data frame of all signals, its index the time [s]; ImportError where pandas is not installed."""
        try:
            import pandas
        except ImportError:
            raise ImportError("to_pandas needs pandas: pip install pandas") from None
        index = pandas.Index(self.time, name="time")
        frame = pandas.DataFrame(self.results.values, index=index, columns=list(self.results.columns))
        for name, column in self.results.exact.items():
            frame[name] = list(column)
        frame.attrs["units"] = dict(self.results.units)
        return frame

    def plot(self, *names: str) -> Figure:
        """A matplotlib figure of signals, those of one unit over each other; of all without names."""
        for name in names:
            self[name]
        from cosim.simulation.report.figures import figure_of

        return figure_of(self.results, names or self.results.columns)

    def __repr__(self) -> str:
        shown = [self._line(name) for name in self.names[:SHOWN]]
        more = [f"  … and {len(self.names) - SHOWN} more"] if len(self.names) > SHOWN else []
        return "\n".join([self._heading(), *shown, *more])

    def _heading(self) -> str:
        end = f", {plain(float(self.time[0]))} … {plain(float(self.time[-1]))} s" if len(self) else ""
        return f"{self.title}: {counted(len(self.names), 'signal')}, {counted(len(self), 'row')}{end}"

    def _line(self, name: str) -> str:
        first, last = self._ends(name)
        return f"  {name} [{self.units.get(name) or '1'}] {first} → {last}"

    def _ends(self, name: str) -> tuple[str, str]:
        values = self.results[name]
        return (plain(float(values[0])), plain(float(values[-1]))) if len(values) else (MISSING, MISSING)

    def _repr_html_(self) -> str:
        from html import escape

        rows = [(name, self.units.get(name, ""), *self._ends(name)) for name in self.names[: 2 * SHOWN]]
        cells = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
        more = len(self.names) - len(rows)
        note = f"<p>… and {more} more</p>" if more > 0 else ""
        head = "<tr><th>signal</th><th>unit</th><th>first</th><th>last</th></tr>"
        return f"<p><b>{escape(self._heading())}</b></p>{self._html_more()}<table>{head}{cells}</table>{note}"

    def _html_more(self) -> str:
        return ""


@dataclass(frozen=True, repr=False)
class Run(Signals):
    """A run: its signals, its manifest, criteria and warnings."""

    manifest: Mapping[str, Any] = field(default_factory=dict)

    @property
    def criteria(self) -> list[dict[str, Any]]:
        """Each criterion with its value, limit and whether it is met."""
        return list(self.manifest.get("criteria") or ())

    @property
    def missed(self) -> list[dict[str, Any]]:
        """Criteria that are not met."""
        return [c for c in self.criteria if not c["met"]]

    @property
    def warnings(self) -> list[str]:
        """What is to be known of the run."""
        return list(self.manifest.get("warnings") or ())

    @property
    def report(self) -> Path | None:
        """Its page, None where none was written."""
        page = None if self.folder is None else self.folder / "report.html"
        return page if page is not None and page.is_file() else None

    @cached_property
    def _sentences(self) -> list[str]:
        from cosim.simulation.criteria import sentence

        return [sentence(c) for c in self.criteria]

    def __repr__(self) -> str:
        return "\n".join([super().__repr__(), *(f"  {line}" for line in self._sentences)])

    def _html_more(self) -> str:
        from html import escape

        lines = "".join(f"<li>{escape(line)}</li>" for line in self._sentences)
        return f"<ul>{lines}</ul>" if lines else ""


@dataclass(frozen=True, repr=False)
class Replay(Signals):
    """A replay: what the FMU and the log show, and what the model misses of it, by horizon, in `residual`."""

    residual: Signals | None = None
    sentence: str = ""

    def __repr__(self) -> str:
        return f"{super().__repr__()}\n  {self.sentence}".rstrip()


@dataclass(frozen=True, repr=False)
class Refined:
    """What a refine found: `record` is refine.json; model.yaml and plant.fmu are in `folder`."""

    record: Mapping[str, Any]
    folder: Path

    @property
    def verdict(self) -> str:
        """effect_found, parameter_error, sensor_error, no_effect, ambiguous or unexplained."""
        return str(self.record.get("verdict", ""))

    @property
    def effects(self) -> list[dict[str, Any]]:
        """What was added, most important first, with values and intervals."""
        return list(self.record.get("effects") or ())

    @property
    def sentence(self) -> str:
        """The finding in words."""
        return str(self.record.get("sentence", ""))

    @property
    def model(self) -> Path:
        """The refined model."""
        return self.folder / "model.yaml"

    @property
    def fmu(self) -> Path:
        """Its FMU."""
        return self.folder / "plant.fmu"

    def to_pandas(self) -> pandas.DataFrame:
        """Errors before and after by part and channel; ImportError where pandas is not installed."""
        try:
            import pandas
        except ImportError:
            raise ImportError("to_pandas needs pandas: pip install pandas") from None
        rows = [
            {"model": model, "part": part, "channel": channel, "rmse": value}
            for model, parts in dict(self.record.get("error") or {}).items()
            if isinstance(parts, Mapping)
            for part, channels in parts.items()
            if isinstance(channels, Mapping)
            for channel, value in channels.items()
        ]
        return pandas.DataFrame(rows, columns=["model", "part", "channel", "rmse"])

    def __repr__(self) -> str:
        return f"{self.verdict}: {self.sentence}"

    def _repr_html_(self) -> str:
        from html import escape

        return f"<p><b>{escape(self.verdict)}</b>: {escape(self.sentence)}</p>"


# -- the verbs --------------------------------------------------------------------------------------


def run(
    scenario: FilePath | Mapping[str, Any],
    out: FilePath | None = None,
    set: Mapping[str, Any] | None = None,
    *,
    seed: int | None = None,
    nearest: bool = False,
    report: bool = True,
    figures: bool = False,
    force: bool = False,
    in_process: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Run:
    """Run a scenario, its file or its content; names of files in a mapping are relative to the current folder.

    out:    folder for results.csv, manifest.json and report.html; nothing is left without
    set:    path → value, over the scenario's own: {"noise": False, "components.plant.start.mass": 2}
    force:  also over what the run of another scenario left in `out`
    nearest, figures, in_process, progress: as `cosim run` has them
    A criterion that is missed is no error: look at `missed`. Raises InputError, FmuError, SimulationError.
    """
    from cosim.simulation.workflow import run as run_file

    overrides = [f"{path}={_as_yaml(value)}" for path, value in (set or {}).items()]
    overrides += [] if seed is None else [f"seed={seed}"]
    with _folder(out) as folder, _scenario_file(scenario, folder) as path:
        outcome = run_file(
            path, folder, overrides, force=force, nearest=nearest, report=report and out is not None,
            figures=figures and out is not None, in_process=in_process, progress=progress,
        )  # fmt: skip
    return _run(outcome.results, outcome.manifest, None if out is None else outcome.folder)


def simulate(
    fmu: FilePath,
    out: FilePath | None = None,
    set: Mapping[str, Any] | None = None,
    *,
    input: FilePath | None = None,
    stop: float | None = None,
    step: float | None = None,
    record: Sequence[str] = (),
    report: bool = True,
    force: bool = False,
    in_process: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Run:
    """Run one FMU over its default experiment.

    out:        folder for scenario.yaml, results.csv, manifest.json and report.html; nothing is left without
    set:        parameters and inputs → value
    input:      a CSV with time and columns named as inputs, played to them
    stop, step: [s], in place of those of the FMU
    record:     locals and parameters to record beside inputs and outputs
    Raises InputError, FmuError, SimulationError.
    """
    from cosim.simulation.single import simulate as simulate_fmu

    with _folder(out) as folder:
        outcome, notes = simulate_fmu(
            fmu, folder, start=dict(set or {}), recorded=input, stop=stop, step=step, record=record,
            report=report and out is not None, force=force, in_process=in_process, progress=progress,
        )  # fmt: skip
    manifest = {**outcome.manifest, "warnings": [*notes, *outcome.manifest["warnings"]]}
    return _run(outcome.results, manifest, None if out is None else outcome.folder)


def replay(
    log: FilePath,
    out: FilePath | None = None,
    fmu: FilePath | None = None,
    *,
    start: Mapping[str, Any] | None = None,
    columns: Mapping[str, str] | None = None,
    report: bool = True,
    in_process: bool = False,
    limits: str = "",
    progress: Callable[[int, int], None] | None = None,
) -> Replay:
    """Drive an FMU, or the plant of this package, with a log's recorded inputs and compare.

    out:     folder for results.csv, residual.csv and report.html; nothing is left without
    start:   start values and parameters of the FMU
    columns: of the log under other names, column → variable
    Raises InputError, FmuError, SimulationError.
    """
    from cosim.residuals.words import verdict
    from cosim.residuals.workflow import replay as replay_log

    with _folder(out) as folder:
        comparison = replay_log(
            log, folder, fmu, start=[f"{n}={_as_yaml(v)}" for n, v in (start or {}).items()],
            columns=[f"{c}={v}" for c, v in (columns or {}).items()], report=report and out is not None,
            in_process=in_process, limits=limits, progress=progress,
        )  # fmt: skip
        return _replay(Path(folder), None if out is None else Path(out), verdict(comparison))


def refine(
    study: FilePath,
    out: FilePath,
    *,
    report: bool = True,
    in_process: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> Refined:
    """Find what a model lacks in measured logs; refine.json, model.yaml, plant.fmu and report.html are left in `out`.

    Raises InputError, FmuError, SimulationError.
    """
    from cosim.refinement.workflow import refine as refine_study

    return Refined(refine_study(study, out, progress, report=report, in_process=in_process).record, Path(out))


def check(files: FilePath | Sequence[FilePath], model: str = "base", *, load: bool = True) -> list[str]:
    """Check a file, or several: what is to be known, a line each; InputError with every fault of all of them."""
    from cosim.checks import check_files

    return check_files(files, model, load=load)


def compare(
    a: FilePath | Signals,
    b: FilePath | Signals,
    out: FilePath | None = None,
    *,
    tolerance: float | None = None,
    absolute: float = 0.0,
) -> Compared:
    """Hold run b against run a, each a folder, a CSV or what a verb returned.

    out:       folder for comparison.json and report.html; nothing is left without
    tolerance: a share of each signal's range in a; absolute: in its unit, added to that
    Differences beyond it are no error: look at `same`. Raises InputError where they share no signal or no time.
    """
    from cosim.comparison.page import compare as compare_runs

    made, _ = compare_runs(_ran(a), _ran(b), out, tolerance=tolerance, absolute=absolute, write=out is not None)
    return made


def _ran(side: FilePath | Signals) -> Any:
    from cosim.comparison.ran import Ran, read_ran

    if not isinstance(side, Signals):
        return read_ran(Path(side))
    manifest = side.manifest if isinstance(side, Run) else {}
    return Ran(side.folder or Path(side.title), side.title, side.results, manifest)


def read(folder: FilePath) -> Run | Replay | Refined | Signals:
    """What `run`, `simulate`, `replay` or `refine` left in a folder, or the signals of a CSV with time first.

    InputError where there is none of it.
    """
    from cosim.comparison.ran import read_ran

    path = Path(folder)
    if (path / "refine.json").is_file():
        return Refined(json.loads((path / "refine.json").read_text(encoding="utf-8")), path)
    if (path / "residual.csv").is_file():
        return _replay(path, path, "")
    ran = read_ran(path)
    if not path.is_dir():
        return Signals(ran.name, ran.results)
    return _run(ran.results, ran.manifest, path)


def _run(results: Results, manifest: Mapping[str, Any], folder: Path | None) -> Run:
    scenario = manifest.get("scenario")
    name = scenario.get("name") if isinstance(scenario, Mapping) else None
    return Run(str(name or (folder.name if folder else "run")), results, folder, manifest)


def _replay(folder: Path, left: Path | None, sentence: str) -> Replay:
    from cosim.results import read_results

    residual = Signals("residual", read_results(folder / "residual.csv"), left)
    return Replay("replay", read_results(folder / "results.csv"), left, residual, sentence)


@contextmanager
def _folder(out: FilePath | None) -> Iterator[Path]:
    """The folder that was asked for, or one that is gone at the end."""
    if out is not None:
        yield Path(out)
        return
    with tempfile.TemporaryDirectory(prefix="cosim-run-", ignore_cleanup_errors=True) as scratch:
        yield Path(scratch)


@contextmanager
def _scenario_file(scenario: FilePath | Mapping[str, Any], out: Path) -> Iterator[Path]:
    """A scenario's file; of a mapping one that is gone at the end, with names of files from the current folder."""
    if not isinstance(scenario, Mapping):
        yield Path(scenario)
        return
    from cosim.simulation.scenario_file import from_here

    told = Path("scenario")
    with tempfile.TemporaryDirectory(prefix="cosim-scenario-") as scratch:
        path = Path(scratch) / "scenario.json"
        try:
            path.write_text(json.dumps(from_here(scenario)), encoding="utf-8")
        except (TypeError, ValueError) as error:
            raise InputError([Fault(told, 0, 0, f"holds what no file can: {error}")]) from None
        try:
            yield path
        except InputError as error:
            at_it = [replace(f, file=told, line=0, column=0) if f.file == path else f for f in error.faults]
            raise InputError(at_it) from None


def _as_yaml(value: Any) -> str:
    """A value of Python as --set takes it."""
    if isinstance(value, os.PathLike):
        return json.dumps(os.fspath(value))
    return json.dumps(value.item() if hasattr(value, "item") and not hasattr(value, "__len__") else value)
