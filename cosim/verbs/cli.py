"""The command line. Each command translates its arguments, calls one function and turns errors into exit codes."""

from __future__ import annotations

import gc
import os
import signal
import sys
import warnings
from pathlib import Path
from typing import Annotated, TextIO

import typer

from cosim.base.errors import (
    CosimError,
    Fault,
    FmuError,
    InputError,
    Interrupted,
    Signalled,
    SimulationError,
    Terminated,
)
from cosim.base.garbage import collect_seldom
from cosim.base.program import STOPPED, as_program
from cosim.base.registry import ExtensionWarning
from cosim.base.version import __version__
from cosim.storage.files import check_text, is_full
from cosim.verbs import register
from cosim.verbs.outcome import told, told_left
from cosim.verbs.streams import echo, open_streams
from cosim.verbs.terminal import (
    Compile,
    Force,
    Format,
    InProcess,
    Json,
    Open,
    Report,
    progress_bar,
    say,
    say_failure,
    say_json,
    say_note,
    say_usage,
)

app = typer.Typer(
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Co-simulate FMUs, hold them against measured logs, and find what a model lacks.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for what the command leaves; made if missing.")]


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
    scenario: Annotated[Path, typer.Argument(help="A scenario.yaml, an SSP, or a manifest.json to repeat that run.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for what it leaves; results/NAME of the scenario without."),
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="path=value, over the scenario's own; e.g. noise=off.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of every random stream, over the scenario's own.")
    ] = None,
    nearest: Annotated[
        bool, typer.Option("--nearest", help="Of each refine that the scenario names, what came nearest in it.")
    ] = False,
    report: Report = True,
    open_: Open = False,
    force: Force = False,
    as_json: Json = False,
    figures: Annotated[bool, typer.Option("--figures", help="Write figures/*.png too.")] = False,
    in_process: InProcess = False,
    format_: Format = "csv",
    compile_: Compile = False,
    coupling: Annotated[
        bool, typer.Option("--coupling-error", help="Run again with half the step, and say what that changes.")
    ] = False,
) -> None:
    """Co-simulate a scenario or an SSP: results.csv, manifest.json and report.html."""
    from cosim.blocks.compiling import compiling
    from cosim.simulation.workflow import run as run_scenario

    overrides = [*(set_ or []), *([] if seed is None else [f"seed={seed}"])]
    with compiling(compile_), progress_bar() as progress:
        outcome = run_scenario(
            scenario, out, overrides, force=force, nearest=nearest, report=report, figures=figures,
            in_process=in_process, format_=format_, progress=progress,
        )  # fmt: skip
    if coupling:
        from cosim.simulation.coupling import coupling_error

        source = Path(outcome.manifest["source"])
        with compiling(compile_):
            changed = coupling_error(source, overrides, nearest=nearest, in_process=in_process).sentence
        echo(changed, err=True) if as_json else say(changed)
    told(outcome, report=report, open_=open_, as_json=as_json)


@app.command()
def build(
    out: Out = Path("build"),
    model: Annotated[
        str | None,
        typer.Option(
            "--model", help="A model.yaml, a refine's folder, or file.py:Class; builds the FMU of that model."
        ),
    ] = None,
    nearest: Annotated[
        bool, typer.Option("--nearest", help="Of the refine that --model names, the model that came nearest.")
    ] = False,
    native: Annotated[
        bool,
        typer.Option("--native", help="Compiled FMUs that need no Python: plant-native.fmu, controller-native.fmu."),
    ] = False,
    fmi: Annotated[int, typer.Option("--fmi", help="Version of FMI of native FMUs, 2 or 3.")] = 2,
    platforms: Annotated[
        str, typer.Option("--platforms", help="Of native FMUs: linux64,win64,darwin64,aarch64-linux,aarch64-darwin.")
    ] = "",
    as_json: Json = False,
) -> None:
    """Build plant.fmu and controller.fmu, and plant-heavy.fmu for scenarios/swap.yaml; or the plant of a model."""
    from cosim.loading.build import build as build_fmus

    if native:
        from cosim.loading.build_native import build_native

        asked = [name.strip() for name in platforms.split(",") if name.strip()]
        native_fmus = build_native(out, model, nearest=nearest, fmi=fmi, platforms=asked)
        for made in native_fmus:
            say(made.sentence)
        if as_json:
            say_json({"built": [{"fmu": str(made.path), "platforms": dict(made.floors)} for made in native_fmus]})
        return
    only_native = [name for name, given in (("--fmi", fmi != 2), ("--platforms", bool(platforms))) if given]
    if only_native:
        message = "is of native FMUs; add --native, or leave it out"
        raise InputError([Fault(Path(name), 0, 0, message) for name in only_native])
    built = list(build_fmus(out, model, nearest=nearest))
    for path in built:
        say(f"built {path}")
    if as_json:
        say_json({"built": [{"fmu": str(path)} for path in built]})


@app.command("export-ssp")
def export(
    scenario: Annotated[Path, typer.Argument(help="A scenario.yaml, or the manifest.json of a run.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The file to write; without, NAME.ssp in this folder.")
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="path=value, over the scenario's own; e.g. step=0.01.")
    ] = None,
    nearest: Annotated[
        bool, typer.Option("--nearest", help="Of each refine that the scenario names, what came nearest in it.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Write a scenario as an SSP 1.0 that other simulators run: noise off, references as FMUs."""
    from cosim.authoring.export import export_ssp

    exported = export_ssp(scenario, out, tuple(set_ or ()), nearest=nearest)
    for note in exported.notes:
        say_note(note)
    say(f"wrote {exported.path}")
    if as_json:
        say_json({"ssp": str(exported.path), "notes": list(exported.notes)})


@app.command()
def check(
    files: Annotated[list[Path], typer.Argument(help="Scenarios, manifests, studies, models, logs (.csv), FMUs.")],
    model: Annotated[
        str | None, typer.Option("--model", help="Whose logs they are: base, a model.yaml, or file.py:Class.")
    ] = None,
    load: Annotated[
        bool, typer.Option("--load/--no-load", help="Load FMUs and step them once, in a process of their own.")
    ] = True,
    column: Annotated[
        list[str] | None,
        typer.Option("--column", help="COLUMN=VARIABLE where logs have other names; measured_speed=w, stamp=time."),
    ] = None,
    compile_: Compile = False,
    as_json: Json = False,
) -> None:
    """Say what is wrong with files, all faults at once."""
    from cosim.blocks.compiling import compiling
    from cosim.logs.log import renamed
    from cosim.verbs.checks import check_files

    try:
        with compiling(compile_):
            lines = check_files(files, model, load=load, columns=renamed(column or (), files[0]))
    except Signalled as ended:
        raise FmuError(ended.reason) from None
    except Terminated as ended:
        raise FmuError(str(ended)) from None
    except (Interrupted, KeyboardInterrupt):
        raise typer.Exit(STOPPED) from None
    except OSError as error:
        if not is_full(error):
            raise
        raise FmuError("the disk is full, so that no FMU can be tried; --no-load checks without") from None
    for line in lines:
        say(line)
    say(f"no fault in {', '.join(map(str, files))}")
    if as_json:
        say_json({"files": [str(file) for file in files], "findings": lines, "faults": []})


def _show_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, file: TextIO | None = None,
    line: str | None = None,
) -> None:  # fmt: skip
    """Show a package that cannot be loaded as one line, other warnings as Python does."""
    if issubclass(category, ExtensionWarning):
        echo(f"warning: {message}", err=True)
    else:
        _python_shows(message, category, filename, lineno, file, line)


_python_shows = warnings.showwarning
warnings.showwarning = _show_warning
register(app)


def entry() -> None:
    """Console entry: an error of ours is a message and its exit code, never a traceback."""
    open_streams()
    collecting = collect_seldom()
    ends = [number for name in ("SIGTERM", "SIGHUP") if (number := getattr(signal, name, None)) is not None]
    before, terminating = {number: signal.getsignal(number) for number in ends}, _Terminating()
    for number, handler in before.items():
        if handler != signal.SIG_IGN:  # nohup
            signal.signal(number, terminating)
    try:
        check_text([*sys.argv[1:], *_here(), os.environ.get("TMPDIR", "")])
        app(standalone_mode=True)
    except SystemExit as ended:
        say_usage(ended.__context__)
        raise
    except CosimError as error:
        echo(str(error) if isinstance(error, InputError) else f"error: {error}", err=True)
        say_failure(error)
        if isinstance(error, SimulationError) and error.left is not None:
            told_left(error.left)
        sys.exit(error.exit_code)
    except Terminated as ended:
        echo(f"error: {ended}", err=True)
        sys.exit(ended.exit_code)
    except MemoryError:
        echo("error: there is not enough memory; run shorter, in longer steps or with less recorded", err=True)
        sys.exit(4)
    except OSError as error:  # a folder that cannot be written, a disk that is full
        where = f"{error.filename}: " if error.filename else ""
        echo(f"error: {where}{'the disk is full' if is_full(error) else error.strerror or error}", err=True)
        sys.exit(SimulationError.exit_code if is_full(error) else 2)
    finally:
        gc.set_threshold(*collecting)
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)


def _here() -> list[str]:
    """The folder of the process, where there still is one."""
    try:
        return [os.getcwd()]
    except OSError:
        return []


class _Terminating:
    """What a command does when it is asked to end: it raises once, and what is half done is removed on the way out."""

    def __init__(self) -> None:
        self.asked = False

    def __call__(self, number: int, frame: object) -> None:
        if not self.asked:
            self.asked = True
            raise Terminated(signal.Signals(number).name)


if __name__ == "__main__":
    as_program(entry)
