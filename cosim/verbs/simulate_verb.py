"""`cosim simulate` and `cosim.simulate`: simulate one FMU without a scenario."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.base.settings import Given, Names, PositiveSeconds, Seconds, normalize_settings
from cosim.storage.files import FilePath
from cosim.storage.folders import results_in
from cosim.verbs.options import Compile, Force, Format, Json, Open, Report, Texts, out_option, time_option
from cosim.verbs.run_verb import say_outcome
from cosim.verbs.terminal import progress_bar, say, table, warn

if TYPE_CHECKING:
    from cosim.simulation.run_signals import Run
    from cosim.storage.results import Results

MAX_SIGNALS = 12  # signals whose values are printed


class Interpolation(StrEnum):
    """Values of an input between two rows."""

    HELD = "held"
    LINEAR = "linear"


def simulate(
    fmu: FilePath,
    out: FilePath | None = None,
    set: Given | None = None,
    *,
    input: FilePath | None = None,
    interpolation: str = "held",
    stop: Seconds | None = None,
    step: PositiveSeconds | None = None,
    record: Names = (),
    report: bool = True,
    force: bool = False,
    in_process: bool = False,
    compile: bool = False,
    format: str = "csv",
    progress: Callable[[int, int], None] | None = None,
) -> Run:
    """Simulate one FMU over its default experiment.

    Args:
        fmu: The FMU.
        out: Folder for scenario.yaml, results.csv, manifest.json and report.html; None writes nothing.
        set: Parameter or input → value, or texts "name=value".
        input: CSV file with time and columns named as inputs.
        interpolation: Values of `input` between two rows: "held" from a row until the next, or "linear".
        stop: End of the simulation, in seconds or with a unit ("4 min"); by default that of the FMU or of `input`.
        step: Communication step, in seconds or with a unit; by default that of the FMU.
        record: Names or patterns of local variables and parameters to record too.
        report: Write report.html.
        force: Write into `out` even if it is not empty; results in it are replaced.
        in_process: Load the FMU into this process, for a debugger.
        compile: Compile and execute the sources of an FMU that has no library for this machine.
        format: File format of the rows: "csv", "parquet", "mat", "hdf5", or one of an installed package.
        progress: Function of (completed steps, all steps).

    Returns:
        The signals, the manifest and the warnings.

    Raises:
        InputError: Every fault of the input.
        FmuError: An FMU cannot be read or loaded.
        SimulationError: The simulation failed; the rows so far are in `out`.
    """
    from cosim.authoring.single import simulate as simulate_fmu
    from cosim.blocks.compiling import compiling
    from cosim.simulation.report import write_pages
    from cosim.simulation.run_signals import run_of

    with compiling(compile), results_in(out, "cosim simulate", force=force) as folder:
        steps = partial(simulate_fmu, stop=stop, step=step, in_process=in_process, progress=progress)
        pages = report and out is not None and write_pages
        leaves = partial(steps, report=pages, format_=format, interpolation=interpolation)
        outcome, notes = leaves(fmu, folder, start=normalize_settings(set), recorded=input, record=record)
    manifest = {**outcome.manifest, "warnings": [*notes, *outcome.manifest["warnings"]]}
    return run_of(outcome.results, manifest, None if out is None else outcome.folder)


def command(
    fmu: Annotated[Path, typer.Argument(help="FMU to simulate.")],
    *,
    set_: Annotated[
        Texts,
        typer.Option("--set", metavar="NAME=VALUE", help="Value of a parameter or input, for example angle=12deg."),
    ] = None,
    recorded: Annotated[
        Path | None,
        typer.Option("--input", help="CSV file with time and columns named as inputs; each row holds until the next."),
    ] = None,
    interpolation: Annotated[
        Interpolation, typer.Option("--interpolation", help="Values of --input between two rows.")
    ] = Interpolation.HELD,
    stop: Annotated[
        float | None,
        time_option("End of the simulation, for example 10 or 4min (default: that of the FMU or of --input)."),
    ] = None,
    step: Annotated[
        float | None, time_option("Communication step, for example 0.02 or 20ms (default: that of the FMU).")
    ] = None,
    record: Annotated[
        Texts,
        typer.Option("--record", metavar="PATTERN", help="Local variables or parameters to record too."),
    ] = None,
    out: Annotated[Path | None, out_option("a new number in results/NAME of the FMU")] = None,
    report: Report = True,
    open_: Open = False,
    force: Force = False,
    as_json: Json = False,
    in_process: Annotated[
        bool, typer.Option("--in-process", help="Load the FMU into the process of the command, for a debugger.")
    ] = False,
    format_: Format = "csv",
    compile_: Compile = False,
) -> None:
    """Simulate one FMU without a scenario.

    Writes results.csv, report.html, and scenario.yaml, which repeats the run.

    Example: cosim simulate plant.fmu --set mass=2 --stop 10
    """
    from cosim.authoring.single import simulate as simulate_fmu
    from cosim.blocks.compiling import compiling
    from cosim.simulation.report import write_pages

    with compiling(compile_), progress_bar() as progress:
        steps = partial(simulate_fmu, stop=stop, step=step, in_process=in_process, progress=progress)
        pages = report and write_pages
        leaves = partial(steps, report=pages, force=force, format_=format_, interpolation=interpolation.value)
        outcome, notes = leaves(fmu, out, start=set_ or (), recorded=recorded, record=record or ())
    warn(*notes)
    if not as_json:
        say(f"scenario: {outcome.folder / 'scenario.yaml'} (change it, and `cosim run` it)")
    say_outcome(outcome, report=report, open_=open_, as_json=as_json, lines=value_lines(outcome.results))


def value_lines(results: Results) -> list[str]:
    """Return a line for each signal with first, last, smallest and largest value."""
    if not len(results.time):
        return []
    rows = []
    for name in results.columns[:MAX_SIGNALS]:
        v = results[name]
        rows.append((f"  {name}", results.units.get(name, ""), *(f"{x:.6g}" for x in (v[0], v[-1], v.min(), v.max()))))
    more = [f"  … and {len(results.columns) - MAX_SIGNALS} more signals"] if len(results.columns) > MAX_SIGNALS else []
    return [*table(("  signal", "unit", "first", "last", "least", "largest"), rows), *more]
