"""`cosim run` and `cosim.run`: simulate a scenario or an SSP."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.core.errors import CriterionMissed, InputError
from cosim.core.scratch import temporary_folder
from cosim.core.settings import Given, Port, Seconds, Seed, Values, texts
from cosim.files.files import FilePath
from cosim.files.folders import NUMBERED, results_in
from cosim.verbs.cli import OUTPUT, echo, live_page, progress_bar, say, say_json, show, warn

if TYPE_CHECKING:
    from cosim.master.observer import NamedFunctions, Observers
    from cosim.simulation.run_signals import Run


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
    until: Seconds | None = None,
    tell: Callable[[str], None] = lambda text: None,
) -> Run:
    """Simulate a scenario or an SSP.

    A criterion that is not met is not an error: see `Run.missed`.

    Args:
        scenario: File, manifest.json, or the content as a mapping with paths relative to the current folder. With
            `resume` or `until`: the folder of a run.
        out: Folder for results.csv, manifest.json and report.html; None writes nothing.
        set: Path → value, for example {"noise": False, "components.plant.start.mass": 2}, or texts "path=value".
        seed: Seed for all random numbers (default: the seed of the scenario).
        pace (NUMBER): Simulated seconds per second: 1 for real time (default: that of the scenario).
        nearest: Use nearest.yaml instead of model.yaml of every refine folder that the scenario names.
        report: Write report.html.
        figures: Write figures/*.png.
        force: Write even if the folder is not empty; results in it are replaced.
        in_process: Load FMUs into this process, for a debugger; limits do not apply.
        compile: Compile and execute the sources of FMUs that have no library for this machine.
        format: File format of the rows: "csv", "parquet", "mat", "hdf5", or one of an installed package.
        progress (in Python): Function of (completed steps, all steps).
        observers (in Python): Objects that receive the rows during the run (`cosim.master.observer.Observer`).
        inputs (in Python): Input → function of time and signals that returns its value during the run, None to hold it.
        resume: Go on with the stopped run in a folder, to the bytes that an uninterrupted run gives.
        until (TIME): Go on with the run in a folder to this simulated time, in seconds or with a unit.
        tell (in Python): Function that shows a note before the steps.

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

    goes_on = (resume or until is not None) and not isinstance(scenario, Mapping)
    if goes_on:
        fixed = {
            "out": out not in {None, NUMBERED},
            "set": bool(set),
            "seed": seed is not None,
            "pace": pace is not None,
        }
        fixed |= {"nearest": nearest, "format": format != "csv"}
        for name in (name for name, is_given in fixed.items() if is_given):
            text = f"a run goes on as it began, so --resume and --until take no --{name}; leave it out"
            raise InputError.at(Path(str(scenario)), text)
    place = nullcontext() if goes_on else results_in(out, "cosim run", force=force)
    with compiling(compile), place as folder, _scenario_file(scenario) as path:
        outcome = run_file(
            path,
            folder,
            _overrides(set, seed, pace),
            force=force,
            nearest=nearest,
            report=(goes_on or out is not None) and partial(write_pages, report=report, figures=figures),
            in_process=in_process,
            format_=format,
            progress=progress,
            observers=observers,
            inputs=inputs,
            resume=resume,
            until=until,
            tell=tell,
        )
    return run_of(outcome.results, outcome.manifest, outcome.folder if goes_on or out is not None else None)


def _overrides(set_: Given | None, seed: int | None, pace: float | None) -> list[str]:
    options = {"seed": seed, "pace": pace}
    return [*texts(set_), *(f"{key}={value}" for key, value in options.items() if value is not None)]


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
            path.write_text(dumps(from_here((), scenario)), encoding="utf-8")
        except (TypeError, ValueError) as error:
            raise InputError.at(label, f"holds what no file can: {error!s}") from None
        try:
            yield path
        except InputError as error:
            faults = [replace(f, file=label, line=0, column=0) if f.file == path else f for f in error.faults]
            raise InputError(faults) from None


def command(
    *,
    coupling_error: bool = False,
    live: bool = False,
    port: Port | None = None,
    open: bool = False,
    json: bool = False,
    **given: Any,
) -> None:
    """Simulate a scenario or an SSP.

    Writes results.csv, manifest.json and report.html. Exit code 5 if a criterion is not met.

    Args:
        scenario: A scenario, an SSP, or the manifest.json of a run to repeat; with --resume or --until the folder of a
            run.
        out (--out -o PATH): Folder for the results (default: a new number in results/NAME of the scenario).
        set (PATH=VALUE): Replace a value of the scenario, for example noise=off.
        coupling_error: Run again with half the step and print the largest change of each output.

    Example: cosim run scenario.yaml --set noise=off --seed 7
    """
    given["out"] = given["out"] or NUMBERED
    title = Path(given["scenario"]).stem
    with progress_bar() as progress, live_page("LiveRun", title, live=live, port=port) as page:
        observers = () if page is None else (page,)
        made = run(**given, progress=progress, observers=observers, tell=warn)
        if page is not None:
            page.show_outcome(made)
    if coupling_error:
        from cosim.blocks.compiling import compiling
        from cosim.simulation.coupling import coupling_error as error_of

        overrides, options = _overrides(given["set"], given["seed"], given["pace"]), ("nearest", "in_process")
        with compiling(given["compile"]):
            source = Path(made.manifest["source"])
            sentence = error_of(source, overrides, **{name: given[name] for name in options}).sentence
        echo(sentence, err=True) if json else say(sentence)
    say_run(made, opens=open)


def say_run(run: Run, *, opens: bool, lines: Sequence[str] = ()) -> None:
    """Print warnings, `lines`, criteria and files of a run; raise CriterionMissed if a criterion is not met."""
    from cosim.files.results import rows_in
    from cosim.simulation.criteria import sentence
    from cosim.simulation.report.run_rows import time_sentence

    assert run.folder is not None  # a command writes
    rows, warnings, timings = rows_in(run.folder), run.manifest["warnings"], run.manifest["timings"]
    warn(*warnings)
    if OUTPUT.as_json:
        say_json(
            {
                "status": "missed" if run.missed else run.manifest["status"],
                "exit_code": CriterionMissed.exit_code if run.missed else 0,
                "met": not run.missed if run.criteria else None,  # nothing was asked for
                "criteria": run.criteria,
                "warnings": warnings,
                "rows": len(run),
                "end": float(run.time[-1]) if len(run) else None,
                "results": str(rows),
                "manifest": str(run.folder / "manifest.json"),
                "report": str(run.report) if run.report else None,
            }
        )
    say(*lines)
    for criterion in run.criteria:
        say(sentence(criterion), met=criterion["met"])
    if OUTPUT.verbose:
        speed = f"simulated in {timings['simulate']:.2f} s ({timings['real_time_factor']:.3g} × real time)"
        order = f"order: {', '.join(run.manifest['order'])}; loaded in {timings['load']:.2f} s, {speed}"
        echo("\n".join(filter(None, (order, time_sentence(timings)))), err=True)
    say(f"results: {rows}")
    if run.report:
        say(f"report:  {run.report}")
        show(run.report, opens)
    if run.missed:
        details = ": " + "; ".join(map(sentence, run.missed)) if OUTPUT.quiet or OUTPUT.as_json else ""
        raise CriterionMissed(f"{len(run.missed)} of {len(run.criteria)} criteria missed{details}")
