"""`cosim fit`: estimate parameters and start values of an FMU from logs."""

from __future__ import annotations

from typing import Any

from cosim.files.folders import NUMBERED
from cosim.verbs.cli import files_in, progress_bar, say, say_json, show, table, warn


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
    from cosim.calibration.workflow import fit
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
