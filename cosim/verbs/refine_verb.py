"""`cosim refine` and `cosim.refine`: find the effect that a model lacks."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.core.errors import InputError
from cosim.core.settings import Files, Port, Values
from cosim.files.files import FilePath
from cosim.files.folders import name_of_file, new_run
from cosim.verbs.cli import files_in, live_page, progress_bar, say, say_json, show, table, warn

if TYPE_CHECKING:
    from cosim.estimation.subject.interface import Subject
    from cosim.refinement.refinement import Refined

FILES = {"model": "model.yaml", "FMU": "plant.fmu", "nearest": "nearest.yaml", "report": "report.html"}


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
) -> Refined:
    """Find the effect that a model lacks, from measured logs.

    Args:
        study: Study file, or an object that derives from `cosim.estimation.subject.interface.Subject`.
        out: Folder for refine.json, model.yaml, plant.fmu and report.html.
        logs (in Python): Estimation logs of an object.
        validation (in Python): Sealed logs of an object.
        settings (in Python): Further keys of a study file, for an object.
        report: Write report.html.
        force: Write even if the folder is not empty; results in it are replaced.
        in_process: Load FMUs into this process, for a debugger; limits do not apply.
        limits: Limits of time and memory in place of those of a study file, for example "total: 10 min".
        progress (in Python): Function of (stage, completed share).

    Returns:
        The verdict, the effects, the refined model and its FMU.

    Raises:
        InputError: Every fault of the input.
        FmuError: An FMU cannot be read or loaded.
        SimulationError: The simulation failed; the rows so far are in `out`.
    """
    from cosim.refinement.refinement import Refined
    from cosim.refinement.study import study_of
    from cosim.refinement.workflow import refine as refine_study

    if isinstance(study, (str, PathLike)):
        if logs or validation or settings:
            text = "logs, validation and settings stand in the file; write them into the study, or give an object"
            raise InputError.at(Path(study), f"{text} in its place")
        source: Any = study
    else:
        source = study_of(study, logs, validation, **(settings or {}))
    with new_run(out, "", "cosim refine", force=force) as place:
        result = refine_study(source, place, progress, report=report, in_process=in_process, limits=limits)
    return Refined(result.record, place, result.variants["after"].subject, result)


def command(
    *, live: bool = False, port: Port | None = None, open: bool = False, json: bool = False, **given: Any
) -> None:
    """Find the effect that a model lacks, from measured logs.

    Writes refine.json, the refined model.yaml and plant.fmu, and report.html.

    Args:
        study: A study: model, estimation logs and validation logs.
        out (--out -o PATH): Folder for the results (default: a new number in results/NAME of the study).

    Example: cosim refine study.yaml --out results/refine
    """
    from cosim.probing.fmu_structure import Structure
    from cosim.refinement.report.refine_page import error_tables, second_sentence
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
        refined = refine(**given, progress=show_stage if page is None else page)
        if page is not None:
            page.show_verdict(refined.record, refined.folder / "report.html")
    result, record, place = refined.details, refined.record, refined.folder
    warn(*result.study.warnings)
    say(f"verdict: {record['verdict']}")
    say(" ".join(s for s in (str(record["sentence"]), second_sentence(result)) if s))
    for errors in error_tables(result)[-1:]:
        has_claim = result.verdict.claimed is not None
        keys = ["channel", "before", "recalibrated", *(["after"] if has_claim else [])]
        keys += ["nearest", "floor"] if errors["nearest"] else ["floor"]
        header = [{"after": "refined", "floor": "noise floor"}.get(key, key) for key in keys]
        say(
            f"\n{errors['title']}, root mean square error:",
            *table(header, [[r[k] for k in keys] for r in errors["rows"]]),
            "",
        )
    for name, file in FILES.items():
        if file != "report.html" or given["report"]:
            say(*([f"{name + ':':9}{place / file}"] if (place / file).is_file() else []))
    if isinstance(original := getattr(result.study.subject, "structure", None), Structure):
        say(f"The FMU holds {original.fmu.name} whole: check that its licence permits you to pass it on.")
    if json:
        answer = {key: record[key] for key in ("verdict", "sentence", "effects", "rivals", "error") if key in record}
        say_json({**answer, **files_in(place, "refine.json", "model.yaml", "plant.fmu")})
    show(place / "report.html", open and given["report"])
    if refined.verdict == "ambiguous":
        from cosim.experiment.rigs import inputs_to_limit

        ranges = [f"--limit {name}=VALUE" for name in inputs_to_limit(result.study.subject)]
        say(f"an experiment that would decide: {' '.join(['cosim excite', shlex.quote(str(place)), *ranges])}")
