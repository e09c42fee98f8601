"""`cosim linearize`: linearize a model about an operating point."""

from __future__ import annotations

from typing import Any

from cosim.files.folders import name_of, new_run
from cosim.verbs.cli import say, say_json, show, table, warn


def command(*, open: bool = False, json: bool = False, **given: Any) -> None:
    """Linearize a model or an FMU about an operating point.

    Prints A, B, C, D, poles and ranks. Writes linear.json, linear.mat, linear.py and report.html.

    Args:
        model: A registered model such as base, a model.yaml, FILE.py:CLASS, the folder of a refine, or an FMU.
        out (--out -o PATH): Folder for the results (default: a new number in results/MODEL-linear).
        at (POINT): Operating point: NAME=VALUE,NAME=VALUE of states and inputs, SCENARIO@TIME, or
            SCENARIO@START:STOP:STEP for a trajectory.
        set (NAME=VALUE): Value of a parameter.
        states (NAME,NAME): States of the linear model, in this order.
        inputs (NAME,NAME): Inputs of the linear model.
        outputs (NAME,NAME): Outputs of the linear model.
        residualize (NAME,NAME): Fast states that are set to their equilibrium.
        component (NAME): Component of the scenario, if several match.
        step (NUMBER): Step of central differences, for example 1e-5; replaces the FMU's derivatives.

    Example: cosim linearize motor.fmu --at speed=100
    """
    from cosim.linearization.descriptions import HEAD, headline, matrix_lines, pole_rows
    from cosim.linearization.workflow import linearize
    from cosim.linearization.write import content

    for key in ("states", "inputs", "outputs", "residualize"):
        given[key] = [name.strip() for text in given[key] for name in text.split(",") if name.strip()]
    run = new_run(given["out"], f"{name_of(str(given['model']))}-linear", "cosim linearize", force=given["force"])
    with run as given["out"]:
        outcome = linearize(**given)
    warn(*outcome.notes)
    if json:
        say_json(content(outcome))
    m, page = outcome.first, given["out"] / "report.html"
    say(headline(outcome.structure, m))
    say(*table(HEAD, [tuple(row.values()) for row in pole_rows(outcome.structure)]))
    for name in "ABCD":
        header, *cells = matrix_lines(name, *m.matrix(name)) or [[name]]
        say(*table(header, cells) if cells else [])
    count = len(outcome.linear)
    several = f", {count} times from {m.point.time:g} s on; above is the first" if count > 1 else ""
    say(f"by {m.method}{several}")
    report = f"; report: {page}" if page.is_file() else ""
    say(f"linear model: {given['out'] / 'linear.json'}, linear.mat, linear.py{report}")
    show(page, open)
