"""`cosim replay` and `cosim.replay`: simulate an FMU with the inputs of a log."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.core.settings import Given, column_names, texts
from cosim.files.files import FilePath
from cosim.files.folders import NUMBERED, name_of_file, results_in
from cosim.verbs.cli import echo, files_in, progress_bar, say, say_json, show, table

if TYPE_CHECKING:
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
        force: Write even if the folder is not empty; results in it are replaced.
        in_process: Load the FMU into this process, for a debugger; limits do not apply.
        compile: Compile and execute the sources of an FMU that has no library for this machine.
        limits: Limits of time and memory, for example "step: 10 s, total: 1 h, memory: 2 GB".
        format: File format of the rows: "csv", "parquet", "mat", "hdf5", or one of an installed package.
        progress (in Python): Function of (completed steps, all steps).

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

    with compiling(compile), results_in(out, "cosim replay", name_of_file(Path(log)), force=force) as folder:
        comparison = replay_log(
            log,
            folder,
            fmu,
            start=texts(start),
            columns=column_names(columns),
            report=report and out is not None,
            in_process=in_process,
            limits=limits,
            format_=format,
            progress=progress,
        )
        result = read_replay(folder, kept=out is not None)
    assert result is not None  # else an error was raised
    return replace(result, comparison=comparison)


def command(*, open: bool = False, json: bool = False, **given: Any) -> None:
    """Simulate an FMU with the recorded inputs of a log, and compare.

    Writes results.csv, residual.csv and report.html, and study.yaml for `cosim refine` if a named FMU lacks something.

    Args:
        log: Measured log: CSV file with time, inputs and measured outputs.
        fmu (--fmu --plant FMU): FMU to simulate (default: the plant of the base model).
        out (--out -o PATH): Folder for the results (default: a new number in results/NAME of the log).
        start (NAME=VALUE): Start value or parameter of the FMU, for example angle=12deg.
        columns (--column COLUMN=VARIABLE): Variable that a column holds, for example stamp=time.

    Example: cosim replay log.csv --plant motor.fmu --column speed=w
    """
    from cosim.core.text import plain, size
    from cosim.files.results import rows_in
    from cosim.residuals.compare import as_json, horizon_name, verdict
    from cosim.residuals.workflow import NEXT_STUDY

    with progress_bar("replaying") as progress:
        replayed = replay(**{**given, "out": given["out"] or NUMBERED}, progress=progress)
    assert replayed.folder is not None  # a command writes
    comparison, place, page = replayed.comparison, replayed.folder, replayed.folder / "report.html"
    for finding in comparison.findings:
        if finding.severity == "warning":
            echo(finding.line, err=True)
    say(verdict(comparison))
    rows = []
    for c in comparison.channels:  # the error of each, beside the noise of its sensor
        error = size(c.scores[c.measure].rmse, c.unit)
        rows.append((c.name, error, horizon_name(c.measure), size(c.noise, c.unit), plain(c.excess, 2)))
    say(*table(("channel", "error (rms)", "over", "noise σ", "error / noise floor"), rows))
    if (study := place / NEXT_STUDY).is_file():
        name = shlex.quote(str(study))
        say(f"next: cosim refine {name}, or its parameters alone: cosim fit {name}")
    say(f"residual: {rows_in(place, 'residual')}" + (f", report: {page}" if page.is_file() else ""))
    if json:
        findings = [finding.line for finding in comparison.findings]
        content = {"sentence": verdict(comparison), "findings": findings, "channels": as_json(comparison)}
        files = [path.name for stem in ("results", "residual") if (path := rows_in(place, stem))]
        say_json({**content, **files_in(place, *files, NEXT_STUDY)})
    show(page, open)
