"""The verbs as functions for Python and notebooks."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.base.errors import Fault, InputError
from cosim.base.scratch import temporary_folder
from cosim.base.settings import Files, Given, ModelName, NotNegative, PositiveSeconds, Seconds, Seed, given, texts
from cosim.storage.files import FilePath, named_path
from cosim.storage.folders import content_of
from cosim.storage.results import Results, read_results, rows_in
from cosim.verbs.outcomes import Refined, Replay, Run, Runs, Signals

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from cosim.comparison.differences import Compared


def run(
    scenario: FilePath | Mapping[str, Any],
    out: FilePath | None = None,
    set: Given | None = None,
    *,
    seed: Seed | None = None,
    nearest: bool = False,
    report: bool = True,
    figures: bool = False,
    force: bool = False,
    in_process: bool = False,
    compile: bool = False,
    format: str = "csv",
    progress: Callable[[int, int], None] | None = None,
) -> Run:
    """Run a scenario, its file or its content; names of files in a mapping are relative to the current folder.

    out:    folder for results.csv, manifest.json and report.html; nothing is left without
    set:    path → value, over the scenario's own: {"noise": False, "components.plant.start.mass": 2};
            or "path=value" each
    force:  also over what the run of another scenario left in `out`
    compile: the sources of FMUs that have no library for this machine are compiled and run
    format: of the rows in `out`: "csv", or "parquet" (results.parquet in place of results.csv)
    nearest, figures, in_process, progress: as `cosim run` has them
    A criterion that is missed is no error: look at `missed`. Raises InputError, FmuError, SimulationError.
    """
    from cosim.blocks.compiling import compiling
    from cosim.simulation.workflow import run as run_file

    overrides = [*texts(set)]
    overrides += [] if seed is None else [f"seed={seed}"]
    with compiling(compile), _folder(out) as folder, _scenario_file(scenario, folder) as path:
        outcome = run_file(
            path, folder, overrides, force=force, nearest=nearest, report=report and out is not None,
            figures=figures and out is not None, in_process=in_process, format_=format, progress=progress,
        )  # fmt: skip
    return _run(outcome.results, outcome.manifest, None if out is None else outcome.folder)


def simulate(
    fmu: FilePath,
    out: FilePath | None = None,
    set: Given | None = None,
    *,
    input: FilePath | None = None,
    stop: Seconds | None = None,
    step: PositiveSeconds | None = None,
    record: Sequence[str] = (),
    report: bool = True,
    force: bool = False,
    in_process: bool = False,
    compile: bool = False,
    format: str = "csv",
    progress: Callable[[int, int], None] | None = None,
) -> Run:
    """Run one FMU over its default experiment.

    out:        folder for scenario.yaml, results.csv, manifest.json and report.html; nothing is left without
    set:        parameters and inputs → value; or "name=value" each
    input:      a CSV with time and columns named as inputs, played to them
    stop, step: [s], or text such as "4 min", in place of those of the FMU
    record:     locals and parameters to record beside inputs and outputs
    compile:    its sources are compiled and run where it has no library for this machine
    Raises InputError, FmuError, SimulationError.
    """
    from cosim.authoring.single import simulate as simulate_fmu
    from cosim.blocks.compiling import compiling

    with compiling(compile), _folder(out) as folder:
        outcome, notes = simulate_fmu(
            fmu, folder, start=given(set), recorded=input, stop=stop, step=step, record=record,
            report=report and out is not None, force=force, in_process=in_process, format_=format, progress=progress,
        )  # fmt: skip
    manifest = {**outcome.manifest, "warnings": [*notes, *outcome.manifest["warnings"]]}
    return _run(outcome.results, manifest, None if out is None else outcome.folder)


def replay(
    log: FilePath,
    out: FilePath | None = None,
    fmu: FilePath | None = None,
    *,
    start: Given | None = None,
    columns: Given | None = None,
    report: bool = True,
    force: bool = False,
    in_process: bool = False,
    compile: bool = False,
    limits: str = "",
    format: str = "csv",
    progress: Callable[[int, int], None] | None = None,
) -> Replay:
    """Drive an FMU, or the plant of this package, with a log's recorded inputs and compare.

    out:     folder for results.csv, residual.csv, replay.json and report.html; nothing is left without
    start:   start values and parameters of the FMU
    columns: of the log under other names, column → variable, or `time`
    force:   also over what another command, or the replay of another log or FMU, left in `out`
    compile: the sources of the FMU are compiled and run where it has no library for this machine
    Raises InputError, FmuError, SimulationError.
    """
    from cosim.blocks.compiling import compiling
    from cosim.residuals.workflow import replay as replay_log

    with compiling(compile), _folder(out) as folder:
        replay_log(
            log, folder, fmu, start=texts(start, "start"),
            columns=_pairs(columns), report=report and out is not None,
            force=force, in_process=in_process, limits=limits, format_=format, progress=progress,
        )  # fmt: skip
        return _replay(Path(folder), None if out is None else Path(out))


def refine(
    study: FilePath,
    out: FilePath,
    *,
    report: bool = True,
    force: bool = False,
    in_process: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> Refined:
    """Find what a model lacks in measured logs; refine.json, model.yaml, plant.fmu and report.html are left in `out`.

    force: also over what another study or command left there
    Raises InputError, FmuError, SimulationError.
    """
    from cosim.refinement.workflow import refine as refine_study

    return Refined(
        refine_study(study, out, progress, report=report, force=force, in_process=in_process).record, Path(out)
    )


def check(
    files: FilePath | Files,
    model: ModelName | None = None,
    *,
    load: bool = True,
    compile: bool = False,
    columns: Mapping[str, str] | None = None,
) -> list[str]:
    """Check a file, or several: what is to be known, a line each; InputError with every fault of all of them.

    model:   whose logs they are; without, a log that is none of base is checked by itself
    columns: of logs under other names than the model's, column → variable, or `time`
    compile: the sources of FMUs that have no library for this machine are compiled and run
    """
    from cosim.blocks.compiling import compiling
    from cosim.verbs.checks import check_files

    with compiling(compile):
        return check_files(files, model, load=load, columns=columns or {})


def compare(
    a: FilePath | Signals,
    b: FilePath | Signals,
    out: FilePath | None = None,
    *,
    tolerance: NotNegative | None = None,
    absolute: NotNegative = 0.0,
    force: bool = False,
) -> Compared:
    """Hold run b against run a, each a folder, a CSV or what a verb returned.

    out:       folder for comparison.json and report.html; nothing is left without
    tolerance: a share of each signal's range in a; absolute: in its unit, added to that
    force:     also over what another command, or the comparison of other runs, left in `out`
    Differences beyond it are no error: look at `same`. Raises InputError where they share no signal or no time.
    """
    from cosim.comparison.workflow import compare as compare_runs

    made, _ = compare_runs(
        _ran(a), _ran(b), out, tolerance=tolerance, absolute=absolute, write=out is not None, force=force
    )
    return made


def _ran(side: FilePath | Signals) -> Any:
    from cosim.comparison.run_files import Ran, read_ran

    if not isinstance(side, Signals):
        return read_ran(Path(side))
    manifest = side.manifest if isinstance(side, Run) else {}
    return Ran(side.folder or Path(side.title), side.title, side.results, manifest)


def read(folder: FilePath) -> Run | Replay | Refined | Runs | Signals:
    """What `run`, `simulate`, `replay`, `refine` or `sweep` left in a folder, or the signals of a CSV with time first.

    InputError where there is none of it.
    """
    from cosim.comparison.run_files import read_ran

    path = Path(folder)
    if (path / "refine.json").is_file():
        return Refined(json.loads((path / "refine.json").read_text(encoding="utf-8")), path)
    if (path / "sweep.json").is_file() and (path / "sweep.parquet").is_file():
        return Runs(content_of(path / "sweep.json"), path)
    if rows_in(path, "residual"):
        return _replay(path, path)
    ran = read_ran(path)
    if not path.is_dir():
        return Signals(ran.name, ran.results)
    return _run(ran.results, ran.manifest, path)


def _run(results: Results, manifest: Mapping[str, Any], folder: Path | None) -> Run:
    scenario = manifest.get("scenario")
    name = scenario.get("name") if isinstance(scenario, Mapping) else None
    return Run(str(name or (folder.name if folder else "run")), results, folder, manifest)


def _pairs(columns: Given | None) -> Sequence[str]:
    found = given(columns, "columns")
    return [f"{column}={variable}" for column, variable in found.items()] if isinstance(found, Mapping) else found


def _replay(folder: Path, left: Path | None) -> Replay:
    from cosim.storage.folders import left_by_replay

    told = left_by_replay(folder)
    units = told.get("units")
    known = {n: str(u) for n, u in units.items()} if isinstance(units, dict) else {}
    files = (rows_in(folder, stem) or folder / f"{stem}.csv" for stem in ("results", "residual"))
    rows, missed = (read_results(file, known) for file in files)
    return Replay("replay", rows, left, Signals("residual", missed, left), str(told.get("sentence", "")))


@contextmanager
def _folder(out: FilePath | None) -> Iterator[Path]:
    """The folder that was asked for, or one that is gone at the end."""
    if out is not None:
        yield named_path(out)
        return
    with temporary_folder("run") as scratch:
        yield scratch


@contextmanager
def _scenario_file(scenario: FilePath | Mapping[str, Any], out: Path) -> Iterator[Path]:
    """A scenario's file; of a mapping one that is gone at the end, with names of files from the current folder."""
    if not isinstance(scenario, Mapping):
        yield Path(scenario)
        return
    from cosim.scenario.scenario_file import from_here

    told = Path("scenario")
    with temporary_folder("scenario") as scratch:
        path = scratch / "scenario.json"
        try:
            path.write_text(json.dumps(from_here(scenario)), encoding="utf-8")
        except (TypeError, ValueError) as error:
            raise InputError([Fault(told, 0, 0, f"holds what no file can: {error}")]) from None
        try:
            yield path
        except InputError as error:
            at_it = [replace(f, file=told, line=0, column=0) if f.file == path else f for f in error.faults]
            raise InputError(at_it) from None
