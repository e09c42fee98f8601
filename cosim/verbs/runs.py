"""The commands that simulate, build and export: run, simulate, init, sweep, build and export-ssp."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.core.errors import CriterionMissed, Fault, refuse
from cosim.core.messages import Note
from cosim.core.settings import Port
from cosim.core.text import displayed, showing, shown_unit
from cosim.files.folders import NUMBERED
from cosim.verbs.cli import OUTPUT, echo, live_page, progress_bar, say, say_json, show, table, warn

if TYPE_CHECKING:
    from cosim.simulation.run_signals import Run

MAX_PRINTED = 12  # signals whose values are printed


def run_command(
    *,
    case: int | None = None,
    coupling_error: bool = False,
    live: bool = False,
    port: Port | None = None,
    open: bool = False,
    json: bool = False,
    **given: Any,
) -> None:
    """Simulate a scenario or an SSP.

    Writes results.csv, manifest.json and report.html. Exit code 5 if a criterion is not met.

    Args:
        scenario: A scenario, an SSP, or the manifest.json of a run to repeat; with --resume or --until the folder of a
            run.
        out (--out -o PATH): Folder for the results (default: a new number in results/NAME of the scenario).
        set (PATH=VALUE): Replace a value of the scenario, for example noise=off.
        case (N): Simulate only run N of a sweep, numbered as in the sweep's table.
        coupling_error: Run again with half the step and print the largest change of each output.

    Example: cosim run scenario.yaml --set noise=off --seed 7
    """
    from cosim.simulation.workflow import overrides_of, run

    given["out"] = given["out"] or NUMBERED
    if case is not None:
        from cosim.sweeps.reading import case_of

        given["scenario"], settings, seed = case_of(Path(given["scenario"]), case)
        given["set"] = [*settings, *(given["set"] or ())]
        given["seed"] = seed if given["seed"] is None else given["seed"]
    title = Path(given["scenario"]).stem
    with progress_bar() as progress, live_page("LiveRun", title, live=live, port=port) as page:
        observers = () if page is None else (page,)
        made = run(**given, progress=progress, observers=observers, tell=warn)
        if page is not None:
            page.show_outcome(made)
    if coupling_error:
        from cosim.blocks.compiling import compiling
        from cosim.simulation.trial import coupling_error as error_of

        overrides = overrides_of(given["set"], given["seed"], given["pace"])
        with compiling(given["compile"]):
            source = Path(made.manifest["source"])
            _, sentence = error_of(source, overrides, in_process=given["in_process"])
        echo(sentence, err=True) if json else say(sentence)
    say_run(made, opens=open)


def say_run(run: Run, *, opens: bool, lines: Sequence[str] = ()) -> None:
    """Print warnings, `lines`, criteria and files of a run; raise CriterionMissed if a criterion is not met."""
    from cosim.files.results import rows_in
    from cosim.simulation.criteria import sentence
    from cosim.simulation.report.recorded import time_sentence

    assert run.folder is not None  # a command always writes into a folder
    rows, warnings, timings = rows_in(run.folder), run.manifest["warnings"], run.manifest["timings"]
    warn(*warnings)
    with showing(run.manifest):
        sentences = [(sentence(criterion), criterion["met"]) for criterion in run.criteria]
    if OUTPUT.as_json:
        say_json(
            {
                "status": "missed" if run.missed else run.manifest["status"],
                "exit_code": CriterionMissed.exit_code if run.missed else 0,
                "met": not run.missed if run.criteria else None,  # None: the scenario has no criteria
                "criteria": run.criteria,
                **({"validity": run.manifest["validity"]} if "validity" in run.manifest else {}),
                "warnings": warnings,
                "rows": len(run),
                "end": float(run.time[-1]) if len(run) else None,
                "results": str(rows),
                "manifest": str(run.folder / "manifest.json"),
                "report": str(run.report) if run.report else None,
            }
        )
    say(*lines, *run.validity)
    for text, met in sentences:
        say(text, met=met)
    if OUTPUT.verbose:
        speed = f"simulated in {timings['simulate']:.2f} s ({timings['real_time_factor']:.3g} × real time)"
        order = f"order: {', '.join(run.manifest['order'])}; loaded in {timings['load']:.2f} s, {speed}"
        echo("\n".join(filter(None, (order, time_sentence(timings)))), err=True)
    say(f"results: {rows}")
    if run.report:
        say(f"report:  {run.report}")
        show(run.report, opens)
    if run.missed:
        details = ": " + "; ".join(text for text, met in sentences if not met) if OUTPUT.quiet or OUTPUT.as_json else ""
        raise CriterionMissed(f"{len(run.missed)} of {len(run.criteria)} criteria missed{details}")


def simulate_command(*, open: bool = False, json: bool = False, **given: Any) -> None:
    """Simulate one FMU without a scenario.

    Writes results.csv, report.html, and scenario.yaml, which repeats the run.

    Args:
        fmu: FMU to simulate.
        out (--out -o PATH): Folder for the results (default: a new number in results/NAME of the FMU).
        set (NAME=VALUE): Value of a parameter or input, for example angle=12deg.
        input (FILE): CSV file with time and columns named as inputs; values are constant between rows.
        columns (--column COLUMN=INPUT): Input that a column of --input drives, for example volts=voltage.
        interpolation (held|linear): Values of --input between two rows: held at the earlier row, or linear.
        stop (TIME): End of the simulation, for example 10 or 4min (default: that of the FMU or of --input).
        step (TIME): Communication step, for example 0.02 or 20ms (default: that of the FMU).
        record (PATTERN): Local variables or parameters to record in addition to inputs and outputs.

    Example: cosim simulate plant.fmu --set mass=2 --stop 10
    """
    from cosim.authoring.single import simulate

    with progress_bar() as progress:
        made = simulate(**{**given, "out": given["out"] or NUMBERED}, progress=progress)
    lines, results = [f"scenario: {made.folder}/scenario.yaml (change it, and `cosim run` it)"], made.results
    shown = results.columns[:MAX_PRINTED] if len(made) else ()
    rows = []
    with showing(made.manifest):
        for name in shown:
            unit = made.units.get(name, "")
            values = displayed(results[name], unit)
            ends = values[0], values[-1], values.min(), values.max()
            rows.append((f"  {name}", shown_unit(unit), *(f"{x:.6g}" for x in ends)))
    lines += table(("  signal", "unit", "first", "last", "least", "largest"), rows) if len(made) else []
    if shown and len(results.columns) > MAX_PRINTED:
        lines.append(f"  … and {len(results.columns) - MAX_PRINTED} more signals")
    say_run(made, opens=open, lines=lines)


def init_command(fmus: list[Path], *, out: Path = Path("scenario.yaml"), json: bool = False) -> None:
    """Write a first scenario that connects FMUs by name and unit.

    Guessed connections are marked in the file. The scenario runs without changes.

    Args:
        fmus (FMU): FMUs to connect.
        out (--out -o PATH): Scenario file; an existing file is not overwritten.

    Example: cosim init plant.fmu controller.fmu --out scenario.yaml
    """
    from cosim.authoring.draft import write_draft
    from cosim.authoring.matching import text
    from cosim.core.text import counted
    from cosim.files.kinds import shell_path

    matches, algorithm, warnings = write_draft(out, fmus)
    if json:
        connections = [
            {"from": text(m.source), "to": text(m.target), "guess": m.guess, "others": m.others}
            for m in matches.connections
        ]
        unconnected = [text(port) for port, _ in matches.unconnected]
        say_json(
            {
                "scenario": str(out),
                "algorithm": algorithm,
                "connections": connections,
                "not_connected": unconnected,
            }
        )
        return
    for m in matches.connections:
        say(f"  {text(m.source)} → {text(m.target)}" + (f"   guess: {m.guess}" if m.guess else ""))
        for other in m.others:
            say(f"      or {other}")
    for port, sources in matches.unconnected:
        say(*([f"  {text(port)} is not connected; outputs that fit: {', '.join(sources)}"] if sources else []))
    warn(*warnings)
    guesses = sum(bool(m.guess) for m in matches.connections)
    parts = [counted(len(fmus), "FMU"), counted(len(matches.connections), "connection")]
    parts += [f"{guesses} guessed (marked in the file)"] if guesses else []
    say(f"wrote {out}: {', '.join(parts)}")
    if matches.connections or not matches.any_candidate:
        say(f"next: cosim run {shell_path(out)}")
    else:
        say(f"next: remove the # before the right connections in {out}, then cosim run {shell_path(out)}")


def sweep_command(
    *, live: bool = False, port: Port | None = None, open: bool = False, json: bool = False, **given: Any
) -> None:
    """Run a scenario many times with varied values.

    Writes sweep.parquet, sweep.json and report.html.

    Args:
        path (SWEEP): Sweep file, which names a scenario and the values that vary.
        out (--out -o PATH): Folder for the results (default: a new number in results/NAME of the sweep).
        dask (ADDRESS): Address of a Dask scheduler, for example tcp://host:8786.
        resume: Continue the stopped sweep in --out (default: the newest).
        part (K/N): Simulate the K-th of N parts of the runs, in a folder given by --out.

    Example: cosim sweep sweep.yaml --workers 4
    """
    from cosim.sweeps.workflow import sweep

    title = Path(given["path"]).stem
    with progress_bar("sweeping") as progress, live_page("LiveSweep", title, live=live, port=port) as page:
        swept = sweep(**given, progress=progress, observers=() if page is None else (page,))
        report = swept.folder / "report.html"
        if page is not None:
            page.report = report
    warn(*swept.sweep.warnings)
    if json:
        say_json({**{k: v for k, v in swept.record.items() if k != "scenario"}, "made": swept.made})
    say(*swept.sentences)
    if swept.made < swept.record["runs"]:
        say(f"new runs: {swept.made}, already stored: {swept.record['runs'] - swept.made}")
    if given["part"]:
        say(f"part:   {swept.folder}")
        return
    say(f"runs:   {swept.folder / 'sweep.parquet'}")
    if given["report"]:
        say(f"report: {report}")
    show(report, open)


def build_command(*, valid_output: Path | None = None, json: bool = False, **given: Any) -> None:
    """Build the FMUs of a model.

    Args:
        folder (--out -o PATH): Folder for the FMUs.
        model (MODEL): Build this model: a registered one, a model.yaml, the folder of a refine, or FILE.py:CLASS.
        design (--design FILE): Design the model's controller with the weights and numbers in this YAML file.
        platforms (NAME,NAME): Platforms of native FMUs (default: this machine).
        valid_output (FMU): Instead, add the output `valid` to this FMU of refine or fit: true within its logs' region.

    Example: cosim build --model results/refine/model.yaml --out build/refined
    """
    given["platforms"] = [p.strip() for text in given["platforms"] for p in text.split(",") if p.strip()]
    if valid_output is not None:
        from cosim.credibility.valid_output import add_valid_output

        others = [f"--{name}" for name in ("model", "nearest", "native", "platforms", "design") if given[name]]
        refuse(Fault(Path(name), 0, 0, "does not apply with --valid-output; remove one of them") for name in others)
        path, left_out = add_valid_output(valid_output, given["folder"])
        warn(*(f"{path} has no library for {platform}: {reason}" for platform, reason in left_out.items()))
        say(f"built {path}")
        built: list[dict[str, Any]] = [{"fmu": str(path)}]
    elif given.pop("native"):
        from cosim.fmi.building.build import build_native

        fmus = build_native(**given, tell=warn)
        say(*(fmu.sentence for fmu in fmus))
        built = [{"fmu": str(fmu.path), "platforms": dict(fmu.floors)} for fmu in fmus]
    else:
        from cosim.fmi.building.build import build

        native_options = [f"--{name}" for name, usual in (("fmi", 2), ("platforms", [])) if given[name] != usual]
        refuse(
            Fault(Path(name), 0, 0, "applies to native FMUs only; add --native, or remove it")
            for name in native_options
        )
        paths = build(**given, tell=warn)
        say(*(f"built {path}" for path in paths))
        built = [{"fmu": str(path)} for path in paths]
    if json:
        say_json({"built": built})


def export_ssp_command(*, json: bool = False, **given: Any) -> None:
    """Write a scenario as an SSP 1.0 file for other simulators.

    Noise is left out. References and recordings become FMUs in C, which requires a C compiler.

    Args:
        path (--out -o PATH): SSP file (default: NAME.ssp in the current folder).
        overrides (--set PATH=VALUE): Replace a value of the scenario, for example duration=10.

    Example: cosim export-ssp scenario.yaml --out system.ssp
    """
    from cosim.authoring.export import export_ssp

    exported = export_ssp(**given)
    warn(*map(Note, exported.notes))
    say(f"wrote {exported.path}")
    if json:
        say_json({"ssp": str(exported.path), "notes": list(exported.notes)})
