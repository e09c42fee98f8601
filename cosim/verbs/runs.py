"""`cosim compare` and `cosim report`: what runs left."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.base.errors import CriterionMissed
from cosim.verbs.terminal import Force, Json, Open, Report, judged, say, say_json, show, table

SHOWN = 12  # signals told on the terminal


def register(app: typer.Typer) -> None:
    """Add these commands."""
    app.command()(compare)
    app.command(name="report")(report_again)


def compare(
    a: Annotated[Path, typer.Argument(help="The folder that a run left, or a CSV with time first.")],
    b: Annotated[Path, typer.Argument(help="Another one, held against it.")],
    tolerance: Annotated[
        float | None,
        typer.Option("--tol", help="Share of each signal's range by which it may differ; beyond it exits 5."),
    ] = None,
    absolute: Annotated[float, typer.Option("--abs", help="In each signal's unit, added to --tol.")] = 0.0,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for comparison.json and report.html; results/A-and-B without."),
    ] = None,
    report: Report = True,
    open_: Open = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Hold one run against another: differences of every signal, criteria side by side, both drawn over each other."""
    from cosim.comparison.differences import sentence
    from cosim.comparison.run_files import read_ran
    from cosim.comparison.signals import shared, sized
    from cosim.comparison.workflow import compare as compare_runs

    if absolute and tolerance is None:
        tolerance = 0.0
    made, folder = compare_runs(
        read_ran(a), read_ran(b), out, tolerance=tolerance, absolute=absolute, report=report, force=force
    )
    if as_json:
        say_json(made.as_json())
    else:
        ranked = [d for d in sorted(made.differences, key=lambda d: -d.share) if d.largest]
        rows = [
            (f"  {d.name}", sized(d, d.largest), f"{d.at:.6g} s", sized(d, d.rms), shared(d),
             ("beyond" if d.beyond else "within") if made.judged else "", d.note)
            for d in ranked[:SHOWN]
        ]  # fmt: skip
        for line in table(("  signal", "largest", "at", "rms", "of its range", "", ""), rows) if rows else []:
            say(line)
        if len(ranked) > SHOWN:
            say(f"  … and {len(ranked) - SHOWN} more that differ")
        for name, only in (("a", made.only_a), ("b", made.only_b)):
            if only:
                say(f"  only in {name}: {', '.join(only[:SHOWN])}{', …' if len(only) > SHOWN else ''}")
        say(judged(made.same, sentence(made)) if made.judged else sentence(made))
        say(f"differences: {folder / 'comparison.json'}")
        if report:
            say(f"report:      {folder / 'report.html'}")
    if report and open_:
        show(folder / "report.html")
    if made.judged and not made.same:
        raise CriterionMissed("; ".join(made.reasons))


def report_again(
    folder: Annotated[Path, typer.Argument(help="The folder that a run left.")],
    figures: Annotated[bool, typer.Option("--figures", help="Write figures/*.png too.")] = False,
    open_: Open = False,
    as_json: Json = False,
) -> None:
    """Make the page of a run again, from its results.csv and manifest.json."""
    from cosim.comparison.report_again import report_of

    page = report_of(folder, figures=figures)
    say(f"report:  {page}")
    if as_json:
        say_json({"report": str(page)})
    if open_:
        show(page)
