"""`cosim linearize`: linearize a model about an operating point."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.storage.folders import name_of, new_run
from cosim.verbs.options import Compile, Force, Json, Open, Report, Texts, out_option
from cosim.verbs.terminal import say, say_json, show, table, warn

if TYPE_CHECKING:
    from cosim.linearization.write import Outcome


def command(
    model: Annotated[
        str,
        typer.Argument(
            help="A registered model such as base, a model.yaml, FILE.py:CLASS, the folder of a refine, or an FMU."
        ),
    ],
    *,
    at: Annotated[
        Texts,
        typer.Option(
            "--at",
            metavar="POINT",
            help="Operating point: NAME=VALUE,NAME=VALUE of states and inputs, SCENARIO@TIME, or "
            "SCENARIO@START:STOP:STEP for a trajectory.",
        ),
    ] = None,
    set_: Annotated[Texts, typer.Option("--set", metavar="NAME=VALUE", help="Value of a parameter.")] = None,
    states: Annotated[
        Texts, typer.Option("--states", metavar="NAME,NAME", help="States of the linear model, in this order.")
    ] = None,
    inputs: Annotated[Texts, typer.Option("--inputs", metavar="NAME,NAME", help="Inputs of the linear model.")] = None,
    outputs: Annotated[
        Texts, typer.Option("--outputs", metavar="NAME,NAME", help="Outputs of the linear model.")
    ] = None,
    residualize: Annotated[
        Texts,
        typer.Option("--residualize", metavar="NAME,NAME", help="Fast states that are set to their equilibrium."),
    ] = None,
    component: Annotated[
        str, typer.Option("--component", metavar="NAME", help="Component of the scenario, if several match.")
    ] = "",
    step: Annotated[
        float | None,
        typer.Option("--step", help="Step of central differences, for example 1e-5; replaces the FMU's derivatives."),
    ] = None,
    out: Annotated[Path | None, out_option("a new number in results/MODEL-linear")] = None,
    report: Report = True,
    open_: Open = False,
    force: Force = False,
    compile_: Compile = False,
    as_json: Json = False,
) -> None:
    """Linearize a model or an FMU about an operating point.

    Prints A, B, C, D, poles and ranks. Writes linear.json, linear.mat, linear.py and report.html.

    Example: cosim linearize motor.fmu --at speed=100
    """
    from cosim.linearization.workflow import linearize as linearize_model

    with new_run(out, f"{name_of(model)}-linear", "cosim linearize", force=force) as place:
        outcome = linearize_model(
            model,
            place,
            at=at or (),
            set=set_ or (),
            states=_names(states),
            inputs=_names(inputs),
            outputs=_names(outputs),
            residualize=_names(residualize),
            component=component,
            step=step,
            report=report,
            force=force,
            compile=compile_,
        )
    warn(*outcome.notes)
    if as_json:
        from cosim.linearization.write import content

        say_json(content(outcome))
    else:
        _say_outcome(outcome, place, report=report)
    show(place / "report.html", open_=report and open_)


def _names(texts: list[str] | None) -> list[str]:
    return [name.strip() for text in texts or () for name in text.split(",") if name.strip()]


def _say_outcome(outcome: Outcome, out: Path, *, report: bool) -> None:
    from cosim.linearization.descriptions import HEAD, headline, matrix_lines, pole_rows

    m = outcome.first
    say(headline(outcome.structure, m))
    say(*table(HEAD, [tuple(row.values()) for row in pole_rows(outcome.structure)]))
    for name in "ABCD":
        header, *cells = matrix_lines(name, *m.matrix(name)) or [[name]]
        say(*table(header, cells) if cells else [])
    count = len(outcome.linear)
    several = f", {count} times from {m.point.time:g} s on; above is the first" if count > 1 else ""
    say(f"by {m.method}{several}")
    page = f"; report: {out / 'report.html'}" if report else ""
    say(f"linear model: {out / 'linear.json'}, linear.mat, linear.py{page}")
