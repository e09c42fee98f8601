"""The command line. Each command translates its arguments, calls one function and turns errors into exit codes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from cosim.errors import CosimError, CriterionMissed, InputError
from cosim.version import __version__

app = typer.Typer(
    help="Co-simulate FMUs, with the thrust-vectoring hovercraft as plant and controller.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for what the command leaves; made if missing.")]
LONG_RUN = 2000  # steps from which a progress bar is shown


def say(text: str) -> None:
    """A line for the user."""
    typer.echo(text)


def _version(asked: bool) -> None:
    if asked:
        say(f"cosim {__version__} (FMU co-simulation; not the command of the Open Simulation Platform)")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Options that stand before the command."""


@app.command()
def run(
    scenario: Annotated[Path, typer.Argument(help="A scenario.yaml, or a manifest.json to repeat that run.")],
    out: Out = Path("results"),
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="path=value, over the scenario's own; e.g. noise=off.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of every random stream, over the scenario's own.")
    ] = None,
    report: Annotated[bool, typer.Option("--report/--no-report", help="Write report.html.")] = True,
    figures: Annotated[bool, typer.Option("--figures", help="Write figures/*.png too.")] = False,
) -> None:
    """Co-simulate a scenario: results.csv, manifest.json and report.html."""
    from cosim.criteria import sentence
    from cosim.run import run as run_scenario

    overrides = [*(set_ or []), *([] if seed is None else [f"seed={seed}"])]
    with progress_bar() as progress:
        outcome = run_scenario(scenario, out, overrides, report=report, figures=figures, progress=progress)
    for warning in outcome.manifest["warnings"]:
        typer.echo(f"warning: {warning}", err=True)
    for criterion in outcome.manifest["criteria"]:
        say(sentence(criterion))
    say(f"results: {out / 'results.csv'}")
    if report:
        say(f"report:  {out / 'report.html'}")
    if outcome.missed:
        raise CriterionMissed(f"{len(outcome.missed)} of {len(outcome.manifest['criteria'])} criteria missed")


@app.command()
def build(
    out: Out = Path("build"),
) -> None:
    """Build plant.fmu and controller.fmu, and plant-heavy.fmu for scenarios/swap.yaml."""
    from fmus.build import HEAVY, controller_recipe, plant_recipe
    from fmus.build import build as build_fmu

    recipes = {
        "plant.fmu": plant_recipe(),
        "controller.fmu": controller_recipe(),
        "plant-heavy.fmu": plant_recipe(HEAVY),
    }
    for name, recipe in recipes.items():
        say(f"built {build_fmu(recipe, out / name)}")


@app.command()
def check(
    files: Annotated[list[Path], typer.Argument(help="Scenarios, manifests or FMUs.")],
) -> None:
    """Say what is wrong with files, all faults at once."""
    from cosim.check import check_files

    check_files(files)
    say(f"no fault in {', '.join(map(str, files))}")


@app.command()
def bench() -> None:
    """Measure this machine: one JSON line of ratios."""
    import json

    from cosim.bench import bench as measure

    say(json.dumps(measure()))


@contextmanager
def progress_bar() -> Iterator[Callable[[int, int], None] | None]:
    """A bar for long runs on a terminal; nothing where nobody watches."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    bar = Progress(
        TextColumn("simulating"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"), TimeRemainingColumn(),
        console=Console(stderr=True), transient=True,
    )  # fmt: skip
    task = None

    def advance(done: int, total: int) -> None:
        nonlocal task
        if total < LONG_RUN:
            return
        if task is None:
            bar.start()
            task = bar.add_task("simulating", total=total)
        bar.update(task, completed=done)

    try:
        yield advance
    finally:
        bar.stop()


def entry() -> None:
    """Console entry: an error of ours is a message and its exit code, never a traceback."""
    try:
        app(standalone_mode=True)
    except CosimError as error:
        typer.echo(str(error) if isinstance(error, InputError) else f"error: {error}", err=True)
        sys.exit(error.exit_code)


if __name__ == "__main__":
    entry()
