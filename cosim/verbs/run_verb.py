"""`cosim run` and `cosim.run`: simulate a scenario or an SSP."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosim.base.errors import CriterionMissed, InputError
from cosim.base.scratch import temporary_folder
from cosim.base.settings import Given, Seed, Values, texts
from cosim.storage.files import FilePath
from cosim.storage.folders import results_in
from cosim.verbs.options import (
    Compile,
    Force,
    Format,
    InProcess,
    Json,
    Live,
    Nearest,
    Open,
    Overrides,
    Port,
    Report,
    live_page,
    out_option,
    time_option,
)
from cosim.verbs.terminal import MANNER, progress_bar, say, say_finding, say_json, say_more, show, warn

if TYPE_CHECKING:
    from cosim.master.observer import NamedFunctions, Observers
    from cosim.simulation.run_signals import Run
    from cosim.simulation.workflow import Outcome


def run(
    scenario: FilePath | Values,
    out: FilePath | None = None,
    set: Given | None = None,
    *,
    seed: Seed | None = None,
    pace: float | None = None,
    nearest: bool = False,
    report: bool = True,
    figures: bool = False,
    force: bool = False,
    in_process: bool = False,
    compile: bool = False,
    format: str = "csv",
    progress: Callable[[int, int], None] | None = None,
    observers: Observers = (),
    inputs: NamedFunctions | None = None,
    resume: bool = False,
    until: float | None = None,
) -> Run:
    """Simulate a scenario or an SSP.

    A criterion that is not met is not an error: see `Run.missed`.

    Args:
        scenario: File, manifest.json, or the content as a mapping with paths relative to the current folder. With
            `resume` or `until`: the folder of a run.
        out: Folder for results.csv, manifest.json and report.html; None writes nothing.
        set: Path → value, for example {"noise": False, "components.plant.start.mass": 2}, or texts "path=value".
        seed: Seed for all random numbers.
        pace: Simulated seconds per second: 1 for real time; None for the pace of the scenario.
        nearest: Use nearest.yaml instead of model.yaml of every refine folder that the scenario names.
        report: Write report.html.
        figures: Write figures/*.png.
        force: Write into `out` even if it is not empty; results in it are replaced.
        in_process: Load FMUs into this process, for a debugger; limits do not apply.
        compile: Compile and execute the sources of FMUs that have no library for this machine.
        format: File format of the rows: "csv", "parquet", "mat", "hdf5", or one of an installed package.
        progress: Function of (completed steps, all steps).
        observers: Objects that receive the rows during the run (`cosim.master.observer.Observer`).
        inputs: Input → function of time and signals that returns its value while the run goes on, None to hold it.
        resume: Go on with the stopped run in a folder, to the bytes that an uninterrupted run gives.
        until: End [s] of a longer run that goes on with the run in a folder.

    Returns:
        The signals, the manifest and the criteria.

    Raises:
        InputError: Every fault of the input.
        FmuError: An FMU cannot be read or loaded.
        SimulationError: The simulation failed; the rows so far are in `out`.
    """
    from cosim.blocks.compiling import compiling
    from cosim.simulation.report import write_pages
    from cosim.simulation.run_signals import run_of
    from cosim.simulation.workflow import run as run_file

    overrides = [*texts(set), *_options(seed=seed, pace=pace)]
    goes_on = (resume or until is not None) and not isinstance(scenario, Mapping)
    if goes_on:
        given = {"out": out is not None, "set": bool(set), "seed": seed is not None, "pace": pace is not None}
        _refuse_options(Path(str(scenario)), {**given, "nearest": nearest})
    place = nullcontext() if goes_on else results_in(out, "cosim run", force=force)
    with compiling(compile), place as folder, _scenario_file(scenario) as path:
        pages: Any = partial(write_pages, report=report, figures=figures) if goes_on or out is not None else False
        steps = partial(run_file, in_process=in_process, progress=progress, observers=observers, inputs=inputs)
        if goes_on:
            outcome = steps(path, report=pages, resume=resume, until=until)
        else:
            outcome = steps(path, folder, overrides, report=pages, nearest=nearest, format_=format)
    return run_of(outcome.results, outcome.manifest, outcome.folder if goes_on or out is not None else None)


def _refuse_options(path: Path, options: Mapping[str, bool]) -> None:
    """Raise InputError for options of new runs."""
    if given := [name for name, is_given in options.items() if is_given]:
        raise InputError.at(
            path, f"a run goes on as it began, so --resume and --until take no {given[0]}; leave it out"
        )


def _options(**keys: Any) -> list[str]:
    """Return the overrides that options make."""
    return [f"{key}={value}" for key, value in keys.items() if value is not None]


@contextmanager
def _scenario_file(scenario: FilePath | Mapping[str, Any]) -> Iterator[Path]:
    """Yield the file of a scenario; the content of a mapping goes to a temporary file."""
    if not isinstance(scenario, Mapping):
        yield Path(scenario)
        return
    from cosim.scenario.scenario_file import from_here

    label = Path("scenario")
    with temporary_folder("scenario") as scratch:
        path = scratch / "scenario.json"
        try:
            path.write_text(json.dumps(from_here(scenario)), encoding="utf-8")
        except (TypeError, ValueError) as error:
            raise InputError.at(label, f"holds what no file can: {error!s}") from None
        try:
            yield path
        except InputError as error:
            faults = [replace(f, file=label, line=0, column=0) if f.file == path else f for f in error.faults]
            raise InputError(faults) from None


def command(
    scenario: Annotated[
        Path,
        typer.Argument(
            help="A scenario, an SSP, or the manifest.json of a run to repeat; with --resume or --until the folder of "
            "a run."
        ),
    ],
    *,
    out: Annotated[Path | None, out_option("a new number in results/NAME of the scenario")] = None,
    set_: Overrides = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed for all random numbers (default: the seed of the scenario).")
    ] = None,
    pace: Annotated[
        float | None,
        typer.Option(help="Simulated seconds per second: 1 for real time (default: that of the scenario)."),
    ] = None,
    nearest: Nearest = False,
    report: Report = True,
    open_: Open = False,
    force: Force = False,
    as_json: Json = False,
    figures: Annotated[bool, typer.Option("--figures", help="Write figures/*.png too.")] = False,
    in_process: InProcess = False,
    format_: Format = "csv",
    compile_: Compile = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the stopped run in a folder, to the same bytes.")
    ] = False,
    until: Annotated[
        float | None, time_option("Go on with the run in a folder to this simulated time, in seconds or with a unit.")
    ] = None,
    coupling: Annotated[
        bool,
        typer.Option(
            "--coupling-error", help="Run again with half the step and print the largest change of each output."
        ),
    ] = False,
    live: Live = False,
    port: Port = None,
) -> None:
    """Simulate a scenario or an SSP.

    Writes results.csv, manifest.json and report.html. Exit code 5 if a criterion is not met.

    Example: cosim run scenario.yaml --set noise=off --seed 7
    """
    from cosim.blocks.compiling import compiling
    from cosim.simulation.report import write_pages
    from cosim.simulation.workflow import run as run_scenario

    overrides = [*(set_ or []), *_options(seed=seed, pace=pace)]
    if resume or until is not None:
        given = {"--out": out is not None, "--set": bool(set_), "--seed": seed is not None, "--nearest": nearest}
        given["--pace"] = pace is not None
        _refuse_options(scenario, {**given, "--format": format_ != "csv"})
    with compiling(compile_), progress_bar() as progress, live_page("run", scenario.stem, live=live, port=port) as page:
        observers = () if page is None else (page,)
        steps = partial(run_scenario, nearest=nearest, in_process=in_process, progress=progress, observers=observers)
        steps = partial(steps, resume=resume, until=until, tell=warn)
        pages = partial(write_pages, report=report, figures=figures)
        outcome = steps(scenario, out, overrides, force=force, report=pages, format_=format_)
        if page is not None:
            page.show_outcome(outcome)
    if coupling:
        from cosim.simulation.coupling import coupling_error

        source = Path(outcome.manifest["source"])
        with compiling(compile_):
            sentence = coupling_error(source, overrides, nearest=nearest, in_process=in_process).sentence
        say_finding(sentence) if as_json else say(sentence)
    say_outcome(outcome, report=report, open_=open_, as_json=as_json)


def say_outcome(
    outcome: Outcome, *, report: bool, open_: bool = False, as_json: bool = False, lines: Sequence[str] = ()
) -> None:
    """Print warnings, `lines`, criteria and files of a run; raise CriterionMissed if a criterion is not met."""
    from cosim.simulation.criteria import sentence
    from cosim.simulation.report.run_rows import time_sentence

    criteria: list[dict[str, Any]] = outcome.manifest["criteria"]
    page = outcome.folder / "report.html"
    warn(*outcome.manifest["warnings"])
    if as_json:
        say_json(_content(outcome))
    else:
        say(*lines)
        for criterion in criteria:
            say(sentence(criterion), met=criterion["met"])
        timings = outcome.manifest["timings"]
        speed = f"simulated in {timings['simulate']:.2f} s ({timings['real_time_factor']:.3g} × real time)"
        say_more(f"order: {', '.join(outcome.manifest['order'])}; loaded in {timings['load']:.2f} s, {speed}")
        if times := time_sentence(timings):
            say_more(times)
        say(f"results: {outcome.file}")
        if report:
            say(f"report:  {page}")
    show(page, open_=report and open_)
    if outcome.missed:
        details = ": " + "; ".join(map(sentence, outcome.missed)) if MANNER.quiet or as_json else ""
        counts = {"missed": len(outcome.missed), "count": len(criteria)}
        raise CriterionMissed("{missed} of {count} criteria missed{criteria}".format(**counts, criteria=details))


def _content(outcome: Outcome) -> dict[str, Any]:
    """Return the JSON object of a run."""
    folder, results = outcome.folder, outcome.results
    page = folder / "report.html"
    criteria, missed = outcome.manifest["criteria"], bool(outcome.missed)
    return {
        "status": "missed" if missed else outcome.manifest["status"],
        "exit_code": CriterionMissed.exit_code if missed else 0,
        "met": not missed if criteria else None,  # nothing was asked for
        "criteria": criteria,
        "warnings": outcome.manifest["warnings"],
        "rows": len(results.time),
        "end": float(results.time[-1]) if len(results.time) else None,
        "results": str(outcome.file),
        "manifest": str(folder / "manifest.json"),
        "report": str(page) if page.is_file() else None,
    }
