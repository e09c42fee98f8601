"""`cosim replay` and `cosim.replay`: simulate an FMU with the inputs of a log."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.base.settings import Given, column_names, texts
from cosim.storage.files import FilePath
from cosim.storage.folders import name_of_file, new_run, results_in
from cosim.verbs.options import Compile, Force, Format, InProcess, Json, LimitsText, Open, Report, Texts, out_option
from cosim.verbs.terminal import files_in, progress_bar, say, say_finding, say_json, show, table

if TYPE_CHECKING:
    from cosim.residuals.compare import Comparison
    from cosim.residuals.replay_signals import Replay


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
    """Simulate an FMU with the recorded inputs of a log, and compare the outputs.

    Args:
        log: Measured log.
        out: Folder for results.csv, residual.csv, replay.json and report.html; None writes nothing.
        fmu: FMU to simulate; None takes the plant of the base model.
        start: Start value or parameter of the FMU → value.
        columns: Column of the log → variable, or "time".
        report: Write report.html.
        force: Write into `out` even if it is not empty; results in it are replaced.
        in_process: Load the FMU into this process, for a debugger; limits do not apply.
        compile: Compile and execute the sources of an FMU that has no library for this machine.
        limits: Limits of time and memory, for example "step: 10 s, total: 1 h, memory: 2 GB".
        format: File format of the rows: "csv", "parquet", "mat", "hdf5", or one of an installed package.
        progress: Function of (completed steps, all steps).

    Returns:
        Signals of FMU and log, and the residual of each horizon.

    Raises:
        InputError: Every fault of the input.
        FmuError: An FMU cannot be read or loaded.
        SimulationError: The simulation failed; the rows so far are in `out`.
    """
    from cosim.blocks.compiling import compiling
    from cosim.residuals.replay_signals import read_replay
    from cosim.residuals.workflow import replay as replay_log

    with compiling(compile), results_in(out, "cosim replay", force=force) as folder:
        drive = partial(replay_log, in_process=in_process, limits=limits, progress=progress)
        posed = partial(drive, start=texts(start), columns=column_names(columns))
        posed(log, folder, fmu, report=report and out is not None, format_=format)
        result = read_replay(Path(folder), kept=out is not None)
    assert result is not None  # else an error was raised
    return result


def command(
    log: Annotated[Path, typer.Argument(help="Measured log: CSV file with time, inputs and measured outputs.")],
    *,
    plant: Annotated[
        Path | None,
        typer.Option("--plant", metavar="FMU", help="FMU to simulate (default: the plant of the base model)."),
    ] = None,
    out: Annotated[Path | None, out_option("a new number in results/NAME of the log")] = None,
    start: Annotated[
        Texts,
        typer.Option(
            "--start", metavar="NAME=VALUE", help="Start value or parameter of the FMU, for example angle=12deg."
        ),
    ] = None,
    column: Annotated[
        Texts,
        typer.Option(
            "--column", metavar="COLUMN=VARIABLE", help="Variable that a column holds, for example stamp=time."
        ),
    ] = None,
    report: Report = True,
    in_process: InProcess = False,
    format_: Format = "csv",
    compile_: Compile = False,
    limits: LimitsText = "",
    open_: Open = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Simulate an FMU with the recorded inputs of a log, and compare.

    Writes results.csv, residual.csv and report.html, and study.yaml for `cosim refine` if a named FMU lacks something.

    Example: cosim replay log.csv --plant motor.fmu --column speed=w
    """
    from cosim.blocks.compiling import compiling
    from cosim.residuals.compare import as_json as numbers
    from cosim.residuals.replay_sentences import verdict
    from cosim.residuals.workflow import NEXT_STUDY
    from cosim.residuals.workflow import replay as replay_log
    from cosim.storage.results import rows_in

    folder = new_run(out, name_of_file(log), "cosim replay", force=force)
    with compiling(compile_), folder as place, progress_bar("replaying") as progress:
        drive = partial(replay_log, in_process=in_process, limits=limits, progress=progress)
        posed = partial(drive, start=start or (), columns=column or ())
        comparison = posed(log, place, plant, report=report, format_=format_)
    for finding in comparison.findings:
        if finding.severity == "warning":
            say_finding(finding.line)
    say(verdict(comparison))
    say(*_error_table(comparison))
    if (study := place / NEXT_STUDY).is_file():
        name = shlex.quote(str(study))
        say(f"next: cosim refine {name}, or its parameters alone: cosim fit {name}")
    say(f"residual: {rows_in(place, 'residual')}" + (f", report: {place / 'report.html'}" if report else ""))
    if as_json:
        findings = [finding.line for finding in comparison.findings]
        content = {"sentence": verdict(comparison), "findings": findings, "channels": numbers(comparison)}
        rows = [path.name for stem in ("results", "residual") if (path := rows_in(place, stem))]
        say_json({**content, **files_in(place, *rows, NEXT_STUDY)})
    show(place / "report.html", open_=report and open_)


def _error_table(comparison: Comparison) -> list[str]:
    """Return the error of each channel as a table, beside the noise of its sensor."""
    from cosim.base.text import plain, size
    from cosim.residuals.replay_sentences import horizon_name

    header = ("channel", "error (rms)", "over", "noise σ", "error / noise floor")
    rows = []
    for c in comparison.channels:
        error = size(c.scores[c.measure].rmse, c.unit)
        rows.append((c.name, error, horizon_name(c.measure), size(c.noise, c.unit), plain(c.excess, 2)))
    return table(header, rows)
