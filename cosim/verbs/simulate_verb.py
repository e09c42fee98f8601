"""`cosim simulate` and `cosim.simulate`: simulate one FMU without a scenario."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from cosim.core.settings import Given, Names, PositiveSeconds, Seconds, normalize_settings
from cosim.files.files import FilePath
from cosim.files.folders import NUMBERED, results_in
from cosim.verbs.cli import progress_bar, table
from cosim.verbs.run_verb import say_run

if TYPE_CHECKING:
    from cosim.simulation.run_signals import Run

MAX_SIGNALS = 12  # signals whose values are printed


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
        force: Write even if the folder is not empty; results in it are replaced.
        in_process: Load the FMU into this process, for a debugger.
        compile: Compile and execute the sources of an FMU that has no library for this machine.
        format: File format of the rows: "csv", "parquet", "mat", "hdf5", or one of an installed package.
        progress (in Python): Function of (completed steps, all steps).

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
        outcome, notes = simulate_fmu(
            fmu,
            folder,
            start=normalize_settings(set),
            recorded=input,
            stop=stop,
            step=step,
            record=record,
            interpolation=interpolation,
            report=report and out is not None and write_pages,
            force=force,
            in_process=in_process,
            format_=format,
            progress=progress,
        )
    manifest = {**outcome.manifest, "warnings": [*notes, *outcome.manifest["warnings"]]}
    return run_of(outcome.results, manifest, None if out is None else outcome.folder)


def command(*, open: bool = False, json: bool = False, **given: Any) -> None:
    """Simulate one FMU without a scenario.

    Writes results.csv, report.html, and scenario.yaml, which repeats the run.

    Args:
        fmu: FMU to simulate.
        out (--out -o PATH): Folder for the results (default: a new number in results/NAME of the FMU).
        set (NAME=VALUE): Value of a parameter or input, for example angle=12deg.
        input (FILE): CSV file with time and columns named as inputs; each row holds until the next.
        interpolation (held|linear): Values of --input between two rows.
        stop (TIME): End of the simulation, for example 10 or 4min (default: that of the FMU or of --input).
        step (TIME): Communication step, for example 0.02 or 20ms (default: that of the FMU).
        record (PATTERN): Local variables or parameters to record too.

    Example: cosim simulate plant.fmu --set mass=2 --stop 10
    """
    with progress_bar() as progress:
        made = simulate(**{**given, "out": given["out"] or NUMBERED}, progress=progress)
    lines, results = [f"scenario: {made.folder}/scenario.yaml (change it, and `cosim run` it)"], made.results
    shown = results.columns[:MAX_SIGNALS] if len(made) else ()
    rows = [
        (f"  {name}", made.units.get(name, ""), *(f"{x:.6g}" for x in (v[0], v[-1], v.min(), v.max())))
        for name in shown
        for v in [results[name]]
    ]
    lines += table(("  signal", "unit", "first", "last", "least", "largest"), rows) if len(made) else []
    if shown and len(results.columns) > MAX_SIGNALS:
        lines.append(f"  … and {len(results.columns) - MAX_SIGNALS} more signals")
    say_run(made, opens=open, lines=lines)
