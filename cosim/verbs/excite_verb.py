"""`cosim excite`: design the input that separates rival hypotheses."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from cosim.storage.folders import name_of, new_run
from cosim.verbs.options import Force, Json, Open, Report, Texts, out_option, time_option
from cosim.verbs.terminal import files_in, say, say_json, show, stages, warn


def command(
    model: Annotated[
        str,
        typer.Argument(
            help="A registered model such as base, a model.yaml, FILE.py:CLASS, an FMU, or a refine.json or its folder."
        ),
    ],
    *,
    against: Annotated[
        Texts,
        typer.Option("--against", metavar="NAME", help="Effect, sensor error or parameter that is a rival hypothesis."),
    ] = None,
    out: Annotated[Path | None, out_option("a new number in results/MODEL-excitation")] = None,
    limit: Annotated[
        Texts,
        typer.Option(
            "--limit",
            metavar="NAME=VALUE",
            help="Largest distance of an input or output from its start value, for example angle=8deg.",
        ),
    ] = None,
    range_: Annotated[
        Texts,
        typer.Option("--range", metavar="NAME=MIN..MAX", help="Range of an input, within the bounds of the model."),
    ] = None,
    measured: Annotated[Texts, typer.Option("--measured", metavar="NAME", help="Output that will be logged.")] = None,
    duration: Annotated[
        float | None,
        time_option("Duration of the experiment, for example 90 or 2min (default: 40 s, longer for a slow model)."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed for the random experiments.")] = 1,
    report: Report = True,
    open_: Open = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Design the input that separates rival hypotheses best.

    Writes excitation.csv, excitation.yaml, a scenario that plays the input, and report.html.

    Example: cosim excite results/refine --limit angle=8deg
    """
    from cosim.experiment.excite import excite as choose_input

    folder = new_run(out, f"{name_of(model)}-excitation", "cosim excite", force=force, goes_on=True)
    with folder as place, stages() as progress:
        choice = choose_input(
            model,
            place,
            against or (),
            limits=limit or (),
            ranges=range_ or (),
            measured=measured or (),
            duration=duration,
            seed=seed,
            report=report,
            progress=progress,
        )
    say(choice.headline)
    for warning in choice.warnings:
        warn(warning)
    say(*choice.sentences)
    scenario = shlex.quote(str(place / "excitation.yaml"))
    say(f"excitation: {place / 'excitation.csv'}, played by: cosim run {scenario}")
    if report:
        say(f"report: {place / 'report.html'}")
    show(place / "report.html", open_=report and open_)
    if as_json:
        apart = [{"pair": list(pair), "standard_deviations": distance} for pair, distance in choice.apart.items()]
        files = {"excitation": str(place / "excitation.csv"), "scenario": str(place / "excitation.yaml")}
        say_json({"apart": apart, "warning": "; ".join(choice.warnings), **files, **files_in(place)})
