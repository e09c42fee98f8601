"""`cosim fit` and `cosim.fit`: estimate parameters and start values of an FMU from logs."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.base.settings import Files, Given, column_names, texts
from cosim.storage.files import FilePath
from cosim.storage.folders import name_of_file, new_run, results_in
from cosim.verbs.options import Compile, Force, InProcess, Json, LimitsText, Open, Report, Texts, out_option
from cosim.verbs.terminal import files_in, say, say_json, show, stages, table, warn

if TYPE_CHECKING:
    from cosim.calibration.fit_record import Record
    from cosim.calibration.fitted import Fitted


def fit(
    logs: FilePath | Files,
    fmu: FilePath | None = None,
    out: FilePath | None = None,
    *,
    vary: Given | None = None,
    start: Given | None = None,
    sealed: Files = (),
    columns: Given | None = None,
    report: bool = True,
    force: bool = False,
    in_process: bool = False,
    compile: bool = False,
    limits: str = "",
    progress: Callable[[str, float], None] | None = None,
) -> Fitted:
    """Estimate parameters and start values of an FMU from measured logs.

    Args:
        logs: Logs of the estimate, or a study file, which names them and the FMU.
        fmu: FMU whose parameters are estimated.
        out: Folder for fit.json, fitted.ssv, fitted.fmu and report.html; None writes nothing.
        vary: Parameter → None, "20%", "LOW..HIGH" or (low, high), or texts as on the command line. By default those
            of the study, or those that the logs determine.
        start: Further value of the FMU, or first value of a parameter → value.
        sealed: Logs for the proof, which the estimate does not use.
        columns: Column of the logs → variable, or "time".
        report: Write report.html.
        force: Write into `out` even if it is not empty; results in it are replaced.
        in_process: Load the FMU into this process, for a debugger; limits do not apply.
        compile: Compile and execute the sources of an FMU that has no library for this machine.
        limits: Limits of time and memory, for example "step: 10 s, total: 1 h"; `total` limits the estimate.
        progress: Function of (stage, share).

    Returns:
        Estimates with 95 % intervals, and the errors before and after.

    Raises:
        InputError: Every fault of the input.
        FmuError: An FMU cannot be read or loaded.
        SimulationError: The FMU fails with the values before the fit, or a limit is reached; the best values so far
            are in `out`.
    """
    from cosim.blocks.compiling import compiling
    from cosim.calibration.fit_study import request_of
    from cosim.calibration.fitted import Fitted
    from cosim.calibration.workflow import fit as fit_logs

    request = request_of(
        [logs] if isinstance(logs, (str, os.PathLike)) else list(logs),
        fmu,
        vary=texts(vary),
        start=texts(start),
        sealed=list(sealed),
        columns=column_names(columns),
        limits=limits,
    )
    with compiling(compile), results_in(out, "cosim fit", force=force) as folder:
        record, _ = fit_logs(
            request,
            folder,
            in_process=in_process,
            report=report and out is not None,
            progress=progress or _silent,
        )
    return Fitted(record.model_dump(mode="json"), None if out is None else Path(out))


def _silent(stage: str, share: float) -> None:
    """Show no progress."""


def command(
    logs: Annotated[
        list[Path],
        typer.Argument(help="Measured logs: CSV files with time, inputs and measured outputs; or a study."),
    ],
    *,
    fmu: Annotated[
        Path | None,
        typer.Option("--fmu", metavar="FMU", help="FMU whose parameters are estimated, if no study names it."),
    ] = None,
    out: Annotated[Path | None, out_option("a new number in results/NAME-fit of the FMU or study")] = None,
    vary: Annotated[
        Texts,
        typer.Option(
            "--vary",
            metavar="NAME[=BOUNDS]",
            help="Parameter to estimate: NAME, NAME=20% (prior) or NAME=LOW..HIGH (default: all identifiable ones).",
        ),
    ] = None,
    start: Annotated[
        Texts,
        typer.Option("--start", metavar="NAME=VALUE", help="Further value of the FMU, or first value of a parameter."),
    ] = None,
    sealed: Annotated[
        list[Path] | None, typer.Option("--sealed", metavar="LOG", help="Log for the proof, not used by the estimate.")
    ] = None,
    column: Annotated[
        Texts,
        typer.Option(
            "--column", metavar="COLUMN=VARIABLE", help="Variable that a column holds, for example stamp=time."
        ),
    ] = None,
    report: Report = True,
    in_process: InProcess = False,
    compile_: Compile = False,
    limits: LimitsText = "",
    open_: Open = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Estimate parameters and start values of an FMU from measured logs.

    Writes fit.json, fitted.ssv, fitted.fmu (if the library of the FMU follows the start values of its file) and
    report.html.

    Example: cosim fit a.csv b.csv --fmu motor.fmu --vary mass=20% --sealed c.csv; or: cosim fit study.yaml
    """
    from cosim.blocks.compiling import compiling
    from cosim.calibration.fit_study import request_of
    from cosim.calibration.workflow import fit as fit_logs

    request = request_of(
        logs,
        fmu,
        vary=vary or (),
        start=start or (),
        sealed=sealed or (),
        columns=column or (),
        limits=limits,
    )
    name = name_of_file(request.fmu if request.yaml is None else logs[0], "fit")
    with compiling(compile_), new_run(out, name, "cosim fit", force=force) as place, stages() as progress:
        record, told = fit_logs(
            request,
            place,
            in_process=in_process,
            report=report,
            progress=progress or _silent,
        )
    warn(*told)
    if as_json:
        say_json({**record.model_dump(mode="json"), "files": files_in(place, "fit.json", "fitted.ssv", "fitted.fmu")})
    else:
        _say(record, place)
    show(place / "report.html", open_=report and open_)


def _say(record: Record, place: Path) -> None:
    """Print the verdict, the estimates and the files."""
    from cosim.base.text import amount

    say(record.sentence)
    rows = []
    for name, p in record.parameters.items():
        interval = "" if p.ci95 is None else " … ".join(amount(end, p.unit, 4) for end in p.ci95)
        rows.append((name, amount(p.start, p.unit, 4), amount(p.value, p.unit, 5), interval, p.status))
    say(*table(("parameter", "before", "estimate", "95 % interval", "status"), rows))
    left = [(c.name, c.reason) for c in record.screening if not c.estimated]
    say(*(table(("not estimated", "reason"), left) if left else []))
    say(*(f"{name + ':':9}{path}" for name, path in files_in(place, "fit.json", "fitted.ssv", "fitted.fmu").items()))
