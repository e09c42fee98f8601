"""`cosim fit` and `cosim.fit`: estimate parameters and start values of an FMU from logs."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from cosim.core.settings import Files, Given, column_names, texts
from cosim.files.files import FilePath
from cosim.files.folders import NUMBERED, name_of_file, results_in
from cosim.verbs.cli import files_in, progress_bar, say, say_json, show, table, warn

if TYPE_CHECKING:
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
        force: Write even if the folder is not empty; results in it are replaced.
        in_process: Load the FMU into this process, for a debugger; limits do not apply.
        compile: Compile and execute the sources of an FMU that has no library for this machine.
        limits: Limits of time and memory, for example "step: 10 s, total: 1 h"; `total` limits the estimate.
        progress (in Python): Function of (stage, share).

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
    name = name_of_file(request.fmu if request.yaml is None else request.yaml.path, "fit")
    with compiling(compile), results_in(out, "cosim fit", name, force=force) as folder:
        record, warnings = fit_logs(
            request,
            folder,
            in_process=in_process,
            report=report and out is not None,
            progress=progress or (lambda stage, share: None),
        )
    return Fitted(record.model_dump(mode="json"), None if out is None else folder, tuple(warnings))


def command(*, open: bool = False, json: bool = False, **given: Any) -> None:
    """Estimate parameters and start values of an FMU from measured logs.

    Writes fit.json, fitted.ssv, fitted.fmu (if the library of the FMU follows the start values of its file) and
    report.html.

    Args:
        logs: Measured logs: CSV files with time, inputs and measured outputs; or a study.
        fmu (--fmu FMU): FMU whose parameters are estimated, if no study names it.
        out (--out -o PATH): Folder for the results (default: a new number in results/NAME-fit of the FMU or study).
        vary (NAME[=BOUNDS]): Parameter to estimate: NAME, NAME=20% (prior) or NAME=LOW..HIGH (default: all
            identifiable ones).
        start (NAME=VALUE): Further value of the FMU, or first value of a parameter.
        sealed (LOG): Log for the proof, not used by the estimate.
        columns (--column COLUMN=VARIABLE): Variable that a column holds, for example stamp=time.

    Example: cosim fit a.csv b.csv --fmu motor.fmu --vary mass=20% --sealed c.csv; or: cosim fit study.yaml
    """
    from cosim.core.text import amount

    with progress_bar() as progress:
        fitted = fit(**{**given, "out": given["out"] or NUMBERED}, progress=progress)
    assert fitted.folder is not None  # a command writes
    warn(*fitted.warnings)
    files = files_in(fitted.folder, "fit.json", "fitted.ssv", "fitted.fmu")
    if json:
        say_json({**fitted.record, "files": files})
    say(fitted.sentence)
    rows = []
    for name, p in fitted.record["parameters"].items():
        unit, interval = p["unit"], " … ".join(amount(end, p["unit"], 4) for end in p["ci95"] or ())
        rows.append((name, amount(p["start"], unit, 4), amount(p["value"], unit, 5), interval, p["status"]))
    say(*table(("parameter", "before", "estimate", "95 % interval", "status"), rows))
    others = [(c["name"], c["reason"]) for c in fitted.record["screening"] if not c["estimated"]]
    say(*(table(("not estimated", "reason"), others) if others else []))
    say(*(f"{name + ':':9}{path}" for name, path in files.items()))
    show(fitted.folder / "report.html", open)
