"""`cosim consistency`: are the estimators as good as they believe?"""

from __future__ import annotations

from typing import Annotated

import typer

from cosim.verbs.terminal import Json, judged, progress_bar, say, say_json, table


def register(app: typer.Typer) -> None:
    """Add this command."""
    app.command()(consistency)


def consistency(
    runs: Annotated[int, typer.Option("--runs", min=2, help="Monte Carlo runs of each case.")] = 50,
    steps: Annotated[int, typer.Option("--steps", min=100, help="Samples of each run.")] = 500,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the random numbers.")] = 1,
    as_json: Json = False,
) -> None:
    """Hold the estimators of the craft against what they believe: NEES and NIS over Monte Carlo runs."""
    from cosim.estimation.consistency import CONSISTENT
    from cosim.estimation.consistency import consistency as over_runs

    with progress_bar("estimating") as progress:
        rows = over_runs(runs, steps, seed, progress)
    if as_json:
        say_json([row.as_json() for row in rows])
        return
    header = ("case", "of", "dof", "mean", "its region", "times above", "below", "at most", "verdict")
    lines = [
        (row.case, row.of, str(r.degrees), f"{r.mean:.3f}", f"{r.region[0]:.3f} … {r.region[1]:.3f}",
         f"{r.above:.1%}", f"{r.below:.1%}", f"{r.most:.1%}", r.sentence)
        for row in rows for r in (row.result,)
    ]  # fmt: skip
    head, *body = table(header, lines)
    say(head)
    for row, line in zip(rows, body, strict=True):
        say(judged(row.result.verdict == CONSISTENT, line))
