"""`cosim replay` and `cosim.replay`: drive an FMU with the recorded inputs of a log."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.base.settings import Given, given, texts
from cosim.storage.files import FilePath
from cosim.storage.folders import folder_of_file
from cosim.storage.results import rows_in
from cosim.verbs.options import Compile, Force, Format, InProcess, Json, Open, Report, Texts, out_option
from cosim.verbs.scratch_results import results_in
from cosim.verbs.streams import echo
from cosim.verbs.terminal import files_in, progress_bar, say, say_json, show, table

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
    """Drive an FMU, or the plant of this package, with a log's recorded inputs and compare.

    out:     folder for results.csv, residual.csv, replay.json and report.html; nothing is left without
    start:   start values and parameters of the FMU
    columns: of the log under other names, column → variable, or `time`
    force:   also over what another command, or the replay of another log or FMU, left in `out`
    compile: the sources of the FMU are compiled and run where it has no library for this machine
    format: of the rows in `out`: "csv", or "parquet" (results.parquet in place of results.csv)
    Raises InputError, FmuError, SimulationError.
    """
    from cosim.blocks.compiling import compiling
    from cosim.residuals.replay_signals import read_replay
    from cosim.residuals.workflow import replay as replay_log

    with compiling(compile), results_in(out) as folder:
        drive = partial(replay_log, in_process=in_process, limits=limits, progress=progress)
        posed = partial(drive, start=texts(start, "start"), columns=_pairs(columns))
        posed(log, folder, fmu, report=report and out is not None, force=force, format_=format)
        result = read_replay(Path(folder), kept=out is not None)
    assert result is not None  # else an error was raised
    return result


def _pairs(columns: Given | None) -> Sequence[str]:
    found = given(columns, "columns")
    return [f"{column}={variable}" for column, variable in found.items()] if isinstance(found, Mapping) else found


def command(
    log: Annotated[Path, typer.Argument(help="A measured log: CSV with time, inputs and measured outputs.")],
    *,
    plant: Annotated[
        Path | None, typer.Option("--plant", help="The FMU to drive; without, the plant of this package.")
    ] = None,
    out: Annotated[Path | None, out_option("results/NAME of the log")] = None,
    start: Annotated[
        Texts,
        typer.Option("--start", help="NAME=VALUE of a start value or parameter of the FMU; gain=0.9, angle=12deg."),
    ] = None,
    column: Annotated[
        Texts,
        typer.Option("--column", help="COLUMN=VARIABLE where the log has another name; speed=motor.w, stamp=time."),
    ] = None,
    report: Report = True,
    in_process: InProcess = False,
    format_: Format = "csv",
    compile_: Compile = False,
    limits: Annotated[
        str, typer.Option("--limits", help="Of what the FMU may take, such as 'step: 10 s, total: 1 h, memory: 2 GB'.")
    ] = "",
    open_: Open = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Drive a plant FMU with a log's recorded inputs and compare: results.csv, residual.csv and report.html."""
    from cosim.blocks.compiling import compiling
    from cosim.residuals.comparison_data import as_json as numbers
    from cosim.residuals.replay_sentences import verdict
    from cosim.residuals.workflow import replay as replay_log

    place = folder_of_file(log) if out is None else out
    with compiling(compile_), progress_bar("replaying") as progress:
        drive = partial(replay_log, in_process=in_process, limits=limits, progress=progress)
        posed = partial(drive, start=start or (), columns=column or ())
        comparison = posed(log, place, plant, report=report, force=force, keep=out is None, format_=format_)
    for finding in comparison.findings:
        if finding.severity == "warning":
            echo(finding.line, err=True)
    say(verdict(comparison))
    for line in _error_table(comparison):
        say(line)
    say(f"residual: {rows_in(place, 'residual')}" + (f", report: {place / 'report.html'}" if report else ""))
    if as_json:
        findings = [finding.line for finding in comparison.findings]
        content = {"sentence": verdict(comparison), "findings": findings, "channels": numbers(comparison)}
        rows = [path.name for stem in ("results", "residual") if (path := rows_in(place, stem))]
        say_json({**content, **files_in(place, *rows)})
    show(place / "report.html", asked=report and open_)


def _error_table(comparison: Comparison) -> list[str]:
    """Return the error of each channel as a table, beside the noise of its sensor."""
    from cosim.base.text import plain, size
    from cosim.residuals.replay_sentences import horizon_name

    header = ("channel", "error (rms)", "over", "noise σ", "error / noise floor")
    rows = [
        (
            c.name,
            size(c.scores[c.measure].rmse, c.unit),
            horizon_name(c.measure),
            size(c.noise, c.unit),
            plain(c.excess, 2),
        )
        for c in comparison.channels
    ]
    return table(header, rows)
