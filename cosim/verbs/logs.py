"""`cosim replay`, `refine` and `excite`: models and measured logs."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import Annotated

import typer

from cosim.base.program import ending_when_stuck
from cosim.storage.folders import folder_named, folder_of_file, name_of
from cosim.storage.results import rows_in
from cosim.verbs.streams import echo
from cosim.verbs.terminal import (
    Compile,
    Force,
    Format,
    InProcess,
    Json,
    Open,
    Report,
    progress_bar,
    say,
    say_json,
    seconds,
    show,
    stages,
    warn,
)


def register(app: typer.Typer) -> None:
    """Add these commands."""
    for command in (replay, refine, excite):
        app.command()(command)


def replay(
    log: Annotated[Path, typer.Argument(help="A measured log: CSV with time, inputs and measured outputs.")],
    plant: Annotated[
        Path | None, typer.Option("--plant", help="The FMU to drive; without, the plant of this package.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for what it leaves; results/NAME of the log without.")
    ] = None,
    start: Annotated[
        list[str] | None,
        typer.Option("--start", help="NAME=VALUE of a start value or parameter of the FMU; gain=0.9, angle=12deg."),
    ] = None,
    column: Annotated[
        list[str] | None,
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
        comparison = replay_log(
            log, place, plant, start=start or (), columns=column or (), report=report, force=force,
            in_process=in_process, limits=limits, format_=format_, progress=progress,
        )  # fmt: skip
    for finding in comparison.findings:
        if finding.severity == "warning":
            echo(finding.line, err=True)
    say(verdict(comparison))
    say(f"residual: {rows_in(place, 'residual')}" + (f", report: {place / 'report.html'}" if report else ""))
    if as_json:
        findings = [finding.line for finding in comparison.findings]
        content = {"sentence": verdict(comparison), "findings": findings, "channels": numbers(comparison)}
        say_json(
            {
                **content,
                **files_in(place, *(path.name for stem in ("results", "residual") if (path := rows_in(place, stem)))),
            }
        )
    if report and open_:
        show(place / "report.html")


def files_in(folder: Path, *names: str) -> dict[str, str]:
    """What is in a folder, by name without its ending."""
    return {name.partition(".")[0]: str(folder / name) for name in (*names, "report.html") if (folder / name).is_file()}


def refine(
    study: Annotated[Path, typer.Argument(help="A study.yaml: model, estimation and validation logs.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for what it leaves; results/NAME of the study without.")
    ] = None,
    report: Report = True,
    in_process: InProcess = False,
    open_: Open = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Find what the model lacks in measured logs: refine.json, model.yaml, plant.fmu and report.html."""
    # fits run side by side; more threads within each only wait for one another (read when numpy is first imported)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from cosim.refinement.report.error_tables import second_sentence
    from cosim.refinement.stages import numbered
    from cosim.refinement.workflow import refine as refine_study

    place = folder_of_file(study) if out is None else out
    with stages(numbered) as progress, ending_when_stuck():
        result = refine_study(study, place, progress, report=report, force=force, in_process=in_process)
    for warning in result.study.warnings:
        warn(warning)
    say(" ".join(s for s in (str(result.record["sentence"]), second_sentence(result)) if s))
    say(f"verdict: {result.record['verdict']}, model: {place / 'model.yaml'}, FMU: {place / 'plant.fmu'}")
    if report:
        say(f"report: {place / 'report.html'}")
    if as_json:
        told_of = ("verdict", "sentence", "effects", "rivals", "error")
        answer = {key: result.record[key] for key in told_of if key in result.record}
        say_json({**answer, **files_in(place, "refine.json", "model.yaml", "plant.fmu")})
    if report and open_:
        show(place / "report.html")
    if result.record["verdict"] == "ambiguous" and not result.study.loaded.model.static:
        from cosim.experiment.ranges import inputs_to_limit

        limits = [f"--limit {name}=VALUE" for name in inputs_to_limit(result.study.loaded.model)]
        say(f"an experiment that would decide: {' '.join(['cosim excite', shlex.quote(str(place)), *limits])}")


def excite(
    model: Annotated[
        str, typer.Argument(help="base, a model.yaml, file.py:Class, or a refine.json (or its folder) with rivals.")
    ],
    against: Annotated[
        list[str] | None, typer.Option("--against", help="An effect, sensor or parameter to tell apart; repeatable.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for what it leaves; results/MODEL-excitation without.")
    ] = None,
    limit: Annotated[
        list[str] | None,
        typer.Option("--limit", help="NAME=VALUE: how far an input or output may go from its start; angle=8deg."),
    ] = None,
    range_: Annotated[
        list[str] | None,
        typer.Option("--range", help="NAME=MIN..MAX: between what an input stays, within what the model declares."),
    ] = None,
    measured: Annotated[
        list[str] | None, typer.Option("--measured", help="An output that will be logged; repeatable.")
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option(
            help="Of the experiment, in seconds or 2min; 40 without, longer for a slow model.",
            parser=seconds,
            metavar="TIME",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the experiments that are tried.")] = 1,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write the input that tells rivals apart best: excitation.csv, and excitation.yaml that plays it."""
    from cosim.experiment.excite import excite as choose

    place = folder_named(name_of(model), "excitation") if out is None else out
    with stages() as progress, ending_when_stuck():
        found = choose(
            model, place, against or (), limits=limit or (), ranges=range_ or (), measured=measured or (),
            duration=duration, seed=seed, force=force, progress=progress,
        )  # fmt: skip
    if found.warning:
        warn(found.warning)
    for line in found.sentences:
        say(line)
    played = shlex.quote(str(place / "excitation.yaml"))
    say(f"excitation: {place / 'excitation.csv'}, played by: cosim run {played}")
    if as_json:
        apart = [{"pair": list(pair), "standard_deviations": distance} for pair, distance in found.apart.items()]
        files = {"excitation": str(place / "excitation.csv"), "scenario": str(place / "excitation.yaml")}
        say_json({"apart": apart, "warning": found.warning, **files})
