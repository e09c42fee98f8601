"""`cosim replay`: simulate an FMU with the inputs of a log."""

from __future__ import annotations

import shlex
from typing import Any

from cosim.files.folders import NUMBERED
from cosim.verbs.cli import echo, files_in, progress_bar, say, say_json, show, table


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
    from cosim.residuals.workflow import NEXT_STUDY, replay

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
