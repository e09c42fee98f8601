"""`cosim identify`: the command that the worked example adds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.verbs.options import Force, Json, Open, Report
from cosim.verbs.terminal import files_in, say, say_json, show, stages, warn


def command(
    protocol: Annotated[
        Path,
        typer.Argument(help="A protocol.yaml: cells, tests, and the bench to play or recordings; or logs of a craft."),
    ],
    *,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for what it leaves; results/NAME of the file without.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Of the bench that is played, over the protocol's own.")
    ] = None,
    report: Report = True,
    open_: Open = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Identify a power-train on a testing bench, or noise and friction from logs: a model, numbers, a page."""
    from plant.identification.input_kind import results_of
    from plant.identification.workflow import identify as identify_bench

    place = results_of(protocol) if out is None else out
    with stages() as progress:
        outcome = identify_bench(protocol, place, progress, report=report, seed=seed, force=force, keep=out is None)
    for text in outcome.warnings:
        warn(text)
    for line in outcome.sentences:
        say(line)
    say(outcome.closing(place))
    if report:
        say(f"report: {place / 'report.html'}")
    if as_json:
        said = {"sentences": list(outcome.sentences), "closing": outcome.closing(place), "warnings": outcome.warnings}
        say_json({**said, **files_in(place, "identify.json", "powertrain.yaml", "model.yaml")})
    show(place / "report.html", asked=report and open_)
