"""`cosim excite`: choose the input that separates rival hypotheses."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from cosim.base.program import ending_when_stuck
from cosim.storage.folders import folder_named, name_of
from cosim.verbs.options import Force, Json, Open, Report, Texts, out_option, time_option
from cosim.verbs.terminal import files_in, say, say_json, show, stages, warn


def command(
    model: Annotated[
        str, typer.Argument(help="base, a model.yaml, file.py:Class, or a refine.json (or its folder) with rivals.")
    ],
    *,
    against: Annotated[
        Texts, typer.Option("--against", help="An effect, sensor or parameter to tell apart; repeatable.")
    ] = None,
    out: Annotated[Path | None, out_option("results/MODEL-excitation")] = None,
    limit: Annotated[
        Texts, typer.Option("--limit", help="NAME=VALUE: how far an input or output may go from its start; angle=8deg.")
    ] = None,
    range_: Annotated[
        Texts,
        typer.Option("--range", help="NAME=MIN..MAX: between what an input stays, within what the model declares."),
    ] = None,
    measured: Annotated[Texts, typer.Option("--measured", help="An output that will be logged; repeatable.")] = None,
    duration: Annotated[
        float | None, time_option("Of the experiment, in seconds or 2min; 40 without, longer for a slow model.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the experiments that are tried.")] = 1,
    report: Report = True,
    open_: Open = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write the input that tells rivals apart best: excitation.csv, excitation.yaml that plays it, and report.html."""
    from cosim.experiment.excite import excite as choose

    place = folder_named(name_of(model), "excitation") if out is None else out
    with stages() as progress, ending_when_stuck():
        found = choose(
            model,
            place,
            against or (),
            limits=limit or (),
            ranges=range_ or (),
            measured=measured or (),
            duration=duration,
            seed=seed,
            report=report,
            force=force,
            keep=out is None,
            progress=progress,
        )
    say(found.headline)
    if found.warning:
        warn(found.warning)
    for line in found.sentences:
        say(line)
    played = shlex.quote(str(place / "excitation.yaml"))
    say(f"excitation: {place / 'excitation.csv'}, played by: cosim run {played}")
    if report:
        say(f"report: {place / 'report.html'}")
    show(place / "report.html", asked=report and open_)
    if as_json:
        apart = [{"pair": list(pair), "standard_deviations": distance} for pair, distance in found.apart.items()]
        files = {"excitation": str(place / "excitation.csv"), "scenario": str(place / "excitation.yaml")}
        say_json({"apart": apart, "warning": found.warning, **files, **files_in(place)})
