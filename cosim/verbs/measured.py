"""The commands for measured logs: replay, fit, refine and excite."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.core.errors import CriterionMissed, InputError
from cosim.core.settings import Files, Port, Values
from cosim.files.files import FilePath
from cosim.files.folders import NUMBERED, name_of, name_of_file, new_run
from cosim.verbs.cli import OUTPUT, echo, files_in, live_page, progress_bar, say, say_json, show, table, warn

if TYPE_CHECKING:
    from cosim.estimation.subject.interface import Subject
    from cosim.refinement.refinement import Refined

REFINE_FILES = "report.html", "refine.json", "model.yaml", "plant.fmu", "nearest.yaml", "nearest.fmu"
MAX_CLASSES = 5  # in the terminal


def replay_command(*, open: bool = False, json: bool = False, **given: Any) -> None:
    """Simulate an FMU with the recorded inputs of a log, and compare.

    Writes results.csv, residual.csv and report.html, and study.yaml for `cosim refine` if the FMU lacks something.

    Args:
        log: Measured log: CSV file with time, inputs and measured outputs.
        fmu (--fmu --plant FMU): FMU to simulate (default: the FMU of the installed base model).
        out (--out -o PATH): Folder for the results (default: a new number in results/NAME of the log).
        start (NAME=VALUE): Start value or parameter of the FMU, for example angle=12deg.
        columns (--column COLUMN=VARIABLE): Variable of the FMU for a column, for example stamp=time.

    Example: cosim replay log.csv --fmu motor.fmu --column speed=w
    """
    from cosim.core.text import plain, showing, size
    from cosim.credibility.validity import validity_sentence
    from cosim.files.folders import replay_record
    from cosim.files.results import rows_in
    from cosim.residuals.compare import as_json, horizon_name, sentence, verdict, worst_first
    from cosim.residuals.report import ANSWER_TONES
    from cosim.residuals.workflow import NEXT_STUDY, replay

    with progress_bar("replaying") as progress:
        replayed = replay(**{**given, "out": given["out"] or NUMBERED}, progress=progress)
    assert replayed.folder is not None  # a command writes
    comparison, place, page = replayed.comparison, replayed.folder, replayed.folder / "report.html"
    for finding in comparison.findings:
        if finding.severity == "warning" or finding.kind == "assumed":
            echo(finding.line, err=True)
    rows, record, answer = [], replay_record(place), verdict(comparison)
    with showing(record):
        text = sentence(comparison)
        for c in worst_first(comparison.channels):  # the error of each channel beside the noise of its sensor
            error = size(c.scores[c.measure].rmse, c.unit)
            rows.append((c.name, error, horizon_name(c.measure), size(c.noise, c.unit), plain(c.excess, 2)))
    say(f"verdict: {answer}", tone=ANSWER_TONES[answer])
    say(text, *filter(None, [validity_sentence("FMU", replayed.validity)]))
    say(*table(("channel", "error (rms)", "over", "noise σ", "error / noise floor"), rows))
    if (study := place / NEXT_STUDY).is_file():
        name = shlex.quote(str(study))
        say(f"next: cosim refine {name}, or to fit parameters only: cosim fit {name}")
    say(f"residual: {rows_in(place, 'residual')}" + (f", report: {page}" if page.is_file() else ""))
    if json:
        findings = [finding.line for finding in comparison.findings]
        content = {
            "verdict": answer,
            "sentence": text,
            "findings": findings,
            "channels": as_json(comparison),
        }
        known = {"validity": replayed.validity} if replayed.validity else {}
        files = [path.name for stem in ("results", "residual") if (path := rows_in(place, stem))]
        say_json({**content, **known, **files_in(place, *files, NEXT_STUDY)})
    show(page, open)


def fit_command(*, open: bool = False, json: bool = False, **given: Any) -> None:
    """Estimate parameters and start values of an FMU from measured logs.

    Writes fit.json, fitted.ssv, fitted.fmu and report.html.

    Args:
        logs: Measured logs: CSV files with time, inputs and measured outputs; or a study.
        fmu (--fmu FMU): FMU whose parameters are estimated, unless a study names it.
        out (--out -o PATH): Folder for the results (default: a new number in results/NAME-fit of the FMU or study).
        vary (NAME[=BOUNDS]): Parameter to estimate: NAME, NAME=20% (prior) or NAME=LOW..HIGH (default: all
            identifiable ones).
        start (NAME=VALUE): Value of another parameter, or initial value of an estimated parameter.
        sealed (LOG): Log for the final check, not used by the estimate.
        per_log (--per-log NAME): Parameter with a value for each log, such as a load that changes between logs.
        profile (NAME): Parameter whose likelihood is profiled, for an asymmetric interval.
        columns (--column COLUMN=VARIABLE): Variable of the FMU for a column, for example stamp=time.

    Example: cosim fit a.csv b.csv --fmu motor.fmu --vary mass=20% --sealed c.csv; or: cosim fit study.yaml
    """
    from cosim.calibration.workflow import fit
    from cosim.core.text import amount, showing

    with progress_bar() as progress:
        fitted = fit(**{**given, "out": given["out"] or NUMBERED}, progress=progress)
    assert fitted.folder is not None  # a command writes
    warn(*fitted.warnings)
    files = files_in(fitted.folder, "fit.json", "fitted.ssv", "fitted.fmu")
    if json:
        say_json({**fitted.record, "files": files})
    say(fitted.sentence)
    rows, profiles = [], []
    with showing(fitted.record):
        for name, p in fitted.record["parameters"].items():
            unit, interval = p["unit"], " … ".join(amount(end, p["unit"], 4) for end in p["ci95"] or ())
            rows.append((name, amount(p["start"], unit, 4), amount(p["value"], unit, 5), interval, p["status"]))
            if p["profile"]:
                ends = ("open" if end is None else amount(end, unit, 4) for end in p["profile"]["ci95"])
                profiles.append(f"{name}: 95 % interval from its profile likelihood {' … '.join(ends)}")
        own = [(e["name"], Path(e["log"]).name, amount(e["value"], e["unit"], 5)) for e in fitted.record["per_log"]]
    say(*table(("parameter", "before", "estimate", "95 % interval", "status"), rows))
    say(*(table(("parameter", "log", "estimate"), own) if own else []), *profiles)
    others = [(c["name"], c["reason"]) for c in fitted.record["screening"] if not c["estimated"]]
    say(*(table(("not estimated", "reason"), others) if others else []))
    say(*(f"{name + ':':9}{path}" for name, path in files.items()))
    show(fitted.folder / "report.html", open)


def refine(
    study: FilePath | Subject,
    out: FilePath,
    *,
    logs: FilePath | Files = (),
    validation: FilePath | Files = (),
    settings: Values | None = None,
    report: bool = True,
    force: bool = False,
    in_process: bool = False,
    limits: str = "",
    progress: Callable[[str, float], None] | None = None,
    tell: Callable[[str], None] = lambda text: None,
) -> Refined:
    """Find the effect that a model lacks, from measured logs.

    Args:
        study: Study file, or an instance of a subclass of `cosim.estimation.subject.interface.Subject`.
        out: Folder for refine.json, model.yaml, plant.fmu and report.html.
        logs (in Python): Estimation logs, if `study` is an object.
        validation (in Python): Sealed logs, if `study` is an object.
        settings (in Python): Further keys of a study, if `study` is an object.
        report: Write report.html.
        force: Write even if the folder is not empty; results in it are replaced.
        in_process: Load FMUs into this process, for a debugger; limits do not apply.
        limits: Limits of time and memory, which replace the limits in the study file, for example "total: 10 min".
        progress (in Python): Function of (stage, completed share).
        tell (in Python): Function that shows a note before the search: what this study cannot test.

    Returns:
        The verdict, the effects, the refined model and its FMU.

    Raises:
        InputError: The input has faults; the error names all of them.
        FmuError: An FMU cannot be read or loaded.
        SimulationError: The simulation failed; the rows so far are in `out`.
    """
    from cosim.refinement.refinement import Refined
    from cosim.refinement.study import study_of
    from cosim.refinement.workflow import refine as refine_study

    if isinstance(study, (str, PathLike)):
        if logs or validation or settings:
            text = "logs, validation and settings belong in the study file; write them there, or give an object"
            raise InputError.at(Path(study), f"{text} instead of the file")
        source: Any = study
    else:
        source = study_of(study, logs, validation, **(settings or {}))
    with new_run(out, "", "cosim refine", force=force) as place:
        result = refine_study(source, place, progress, report=report, in_process=in_process, limits=limits, tell=tell)
    return Refined(result.record, place, result.variants["after"].subject, result)


def refine_command(
    *, live: bool = False, port: Port | None = None, open: bool = False, json: bool = False, **given: Any
) -> None:
    """Find the effect that a model lacks, from measured logs.

    Writes refine.json, the refined model.yaml and plant.fmu, and report.html.

    Args:
        study: Study file, which names a model, estimation logs and validation logs.
        out (--out -o PATH): Folder for the results (default: a new number in results/NAME of the study).

    Example: cosim refine study.yaml --out results/refine
    """
    from cosim.core.text import percent
    from cosim.refinement.report.refine_page import answer_of, posterior_rows
    from cosim.refinement.stages import stage_number

    study = Path(given["study"])

    def show_stage(stage: str, share: float) -> None:
        number, of = stage_number(stage)
        if bar is not None:
            bar(f"stage {number} of {of}: {stage}" if number else stage, share)

    with (
        new_run(given["out"], name_of_file(study), "cosim refine", force=given["force"]) as given["out"],
        progress_bar() as bar,
        live_page("LiveRefine", study.stem, live=live, port=port, progress=show_stage) as page,
    ):
        refined = refine(**given, progress=show_stage if page is None else page, tell=warn)
        if page is not None:
            page.show_verdict(refined.record, refined.folder / "report.html")
    result, record, place = refined.details, refined.record, refined.folder
    warn(*result.study.warnings)
    answer = answer_of(result)
    say(f"verdict: {answer.word}", tone=answer.tone)
    say(answer.headline, *answer.lines)
    rows = [(percent(k["share"]), k["names"], k["error"], k["sealed"], k["why"]) for k in posterior_rows(result)]
    say(*table(("probability", "missing parts", "held-out error", "sealed error", "outcome"), rows[:MAX_CLASSES]))
    if OUTPUT.verbose and answer.details:
        say(answer.details)
    say(f"next: {answer.step} {answer.command}".rstrip())
    say(f"results: {place} ({', '.join(file for file in REFINE_FILES if (place / file).is_file())})")
    if json:
        answers = {key: record[key] for key in ("verdict", "sentence", "effects", "rivals", "error") if key in record}
        say_json({**answers, **files_in(place, "refine.json", "model.yaml", "plant.fmu")})
    show(place / "report.html", open and given["report"])


def excite_command(*, open: bool = False, json: bool = False, **given: Any) -> None:
    """Design the input that separates rival hypotheses best.

    Writes excitation.csv, excitation.yaml (a scenario with this input) and report.html.

    Args:
        text (MODEL): A registered model such as base, a model.yaml, FILE.py:CLASS, an FMU, or a refine.json or its
            folder.
        folder (--out -o PATH): Folder for the results (default: a new number in results/MODEL-excitation).
        against (--against NAME): Effect, sensor error or parameter that is a rival hypothesis.
        limits (--limit NAME=VALUE): Largest distance of an input or output from its start value, for example
            angle=8deg.
        ranges (--range NAME=MIN..MAX): Range of an input, within the bounds of the model.
        measured (NAME): Output that will be logged.
        duration (TIME): Duration of the experiment, for example 90 or 2min (default: 40 s, longer for a slow model).

    Example: cosim excite results/refine --limit angle=8deg
    """
    from cosim.experiment.excite import excite

    run = new_run(given["folder"], f"{name_of(given['text'])}-excitation", "cosim excite", force=given["force"])
    with run as place, progress_bar() as progress:
        choice = excite(**{**given, "folder": place}, progress=progress)
    say(choice.headline)
    warn(*choice.warnings)
    say(*choice.sentences)
    files = {"excitation": str(place / "excitation.csv"), "scenario": str(place / "excitation.yaml")}
    say(f"excitation: {files['excitation']}, simulate it with: cosim run {shlex.quote(files['scenario'])}")
    pages = files_in(place)
    say(*(f"report: {page}" for page in pages.values()))
    show(place / "report.html", open)
    if json:
        apart = [{"pair": list(pair), "standard_deviations": distance} for pair, distance in choice.apart.items()]
        say_json({"apart": apart, "warning": "; ".join(choice.warnings), "excess": choice.excess, **files, **pages})
    if choice.excess > 1.0:
        raise CriterionMissed("the planned input exceeds a limit for at least one rival")
