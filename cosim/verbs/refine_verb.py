"""`cosim refine` and `cosim.refine`: find the effect that a model lacks."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosim.base.errors import InputError
from cosim.base.settings import Files, Values
from cosim.storage.files import FilePath
from cosim.storage.folders import name_of_file, new_run
from cosim.verbs.options import Force, InProcess, Json, LimitsText, Live, Open, Port, Report, live_page, out_option
from cosim.verbs.terminal import files_in, say, say_json, show, stages, table, warn

if TYPE_CHECKING:
    from cosim.refinement.refined_result import Refined
    from cosim.refinement.refinement import Refinement
    from cosim.subject.interface import Subject


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
        study: Study file, or an object that derives from `cosim.subject.interface.Subject`.
        out: Folder for refine.json, model.yaml, plant.fmu and report.html.
        logs: Estimation logs of an object.
        validation: Sealed logs of an object.
        settings: Further keys of a study file, for an object.
        report: Write report.html.
        force: Write into `out` even if it is not empty; results in it are replaced.
        in_process: Load FMUs into this process, for a debugger; limits do not apply.
        limits: Limits of time and memory in place of those of a study file, for example "total: 10 min".
        progress: Function of (stage, completed share).

    Returns:
        The verdict, the effects, the refined model and its FMU.

    Raises:
        InputError: Every fault of the input.
        FmuError: An FMU cannot be read or loaded.
        SimulationError: The simulation failed; the rows so far are in `out`.
    """
    from cosim.refinement.refined_result import Refined
    from cosim.refinement.study import study_of
    from cosim.refinement.workflow import refine as refine_study

    if isinstance(study, (str, PathLike)):
        if logs or validation or settings:
            raise InputError.at(
                Path(study),
                (
                    "logs, validation and settings stand in the file; write them into the study, or give an object "
                    "in its place"
                ),
            )
        source: Any = study
    else:
        source = study_of(study, logs, validation, **(settings or {}))
    with new_run(out, "", "cosim refine", force=force) as place:
        result = refine_study(source, place, progress, report=report, in_process=in_process, limits=limits)
    return Refined(result.record, place, result.refined)


def command(
    study: Annotated[Path, typer.Argument(help="A study: model, estimation logs and validation logs.")],
    *,
    out: Annotated[Path | None, out_option("a new number in results/NAME of the study")] = None,
    report: Report = True,
    in_process: InProcess = False,
    limits: LimitsText = "",
    open_: Open = False,
    force: Force = False,
    as_json: Json = False,
    live: Live = False,
    port: Port = None,
) -> None:
    """Find the effect that a model lacks, from measured logs.

    Writes refine.json, the refined model.yaml and plant.fmu, and report.html.

    Example: cosim refine study.yaml --out results/refine
    """
    from cosim.refinement.stages import stage_number
    from cosim.refinement.workflow import refine as refine_study

    with (
        new_run(out, name_of_file(study), "cosim refine", force=force) as place,
        stages(stage_number) as progress,
        live_page("refine", study.stem, live=live, port=port, progress=progress) as page,
    ):
        told = progress if page is None else page
        options: dict[str, Any] = {"report": report, "in_process": in_process, "limits": limits}
        result = refine_study(study, place, told, **options)
        if page is not None:
            page.show_verdict(result.record, place / "report.html")
    warn(*result.study.warnings)
    _say_verdict(result, place, report=report)
    if as_json:
        keys = ("verdict", "sentence", "effects", "rivals", "error")
        answer = {key: result.record[key] for key in keys if key in result.record}
        say_json({**answer, **files_in(place, "refine.json", "model.yaml", "plant.fmu")})
    show(place / "report.html", open_=report and open_)
    if result.record["verdict"] == "ambiguous":
        from cosim.experiment.ranges import inputs_to_limit

        ranges = [f"--limit {name}=VALUE" for name in inputs_to_limit(result.study.subject)]
        say(f"an experiment that would decide: {' '.join(['cosim excite', shlex.quote(str(place)), *ranges])}")


def _say_verdict(result: Refinement, place: Path, *, report: bool) -> None:
    """Print the verdict, a table of errors on the decisive logs, and the files."""
    from cosim.probing.fmu_structure import Structure
    from cosim.refinement.report.error_tables import error_tables, second_sentence

    say(f"verdict: {result.record['verdict']}")
    say(" ".join(s for s in (str(result.record["sentence"]), second_sentence(result)) if s))
    for errors in error_tables(result)[-1:]:
        has_claim = result.verdict.claimed is not None
        header = ("channel", "before", "recalibrated", "refined" if has_claim else "", "nearest", "noise floor")
        rows = []
        for r in errors.rows:
            after, nearest = r.after if has_claim else "", r.nearest if errors.nearest else ""
            rows.append((r.channel, r.before, r.recalibrated, after, nearest, r.floor))
        say(f"\n{errors.title}, root mean square error:", *table(header, rows), "")
    _say_files(place, report=report)
    if isinstance(original := getattr(result.study.subject, "structure", None), Structure):
        say(f"The FMU holds {original.fmu.name} whole: check that its licence permits you to pass it on.")


def _say_files(place: Path, *, report: bool) -> None:
    """Print the written files."""
    files = {
        "model": ["model.yaml"],
        "FMU": ["plant.fmu"],
        "nearest": ["nearest.yaml", "nearest.fmu"],
        "report": ["report.html"] if report else [],
    }
    for name, choices in files.items():
        if file := next((place / choice for choice in choices if (place / choice).is_file()), None):
            say(f"{name + ':':9}{file}")
