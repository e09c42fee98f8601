"""`cosim build`: build FMUs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.base.errors import Fault, refuse
from cosim.fmi.native.compiler import PLATFORMS
from cosim.verbs.options import Json
from cosim.verbs.terminal import say, say_json, warn

Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for the FMUs.")]


def command(
    out: Out = Path("build"),
    *,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            metavar="MODEL",
            help="Build this model: a registered one, a model.yaml, the folder of a refine, or FILE.py:CLASS.",
        ),
    ] = None,
    nearest: Annotated[
        bool, typer.Option("--nearest", help="Use nearest.yaml instead of model.yaml of the refine folder.")
    ] = False,
    design: Annotated[
        Path | None,
        typer.Option("--design", help="Design the model's controller by the weights and numbers in this YAML file."),
    ] = None,
    native: Annotated[
        bool,
        typer.Option("--native", help="Build compiled FMUs, which need no Python."),
    ] = False,
    fmi: Annotated[int, typer.Option("--fmi", help="FMI version of native FMUs, 2 or 3.")] = 2,
    platforms: Annotated[
        str,
        typer.Option(
            "--platforms",
            metavar="NAME,NAME",
            help=f"Platforms of native FMUs, from {', '.join(PLATFORMS)} (default: this machine).",
        ),
    ] = "",
    as_json: Json = False,
) -> None:
    """Build the FMUs of a model.

    Without --model: all FMUs of the base model.

    Example: cosim build --model results/refine/model.yaml --out build/refined
    """
    from cosim.loading.build import build as build_fmus

    if native:
        from cosim.loading.build_native import build_native

        names = [name.strip() for name in platforms.split(",") if name.strip()]
        fmus = build_native(out, model, nearest=nearest, fmi=fmi, platforms=names, design=design, tell=warn)
        for fmu in fmus:
            say(fmu.sentence)
        if as_json:
            say_json({"built": [{"fmu": str(fmu.path), "platforms": dict(fmu.floors)} for fmu in fmus]})
        return
    native_options = [name for name, is_set in (("--fmi", fmi != 2), ("--platforms", bool(platforms))) if is_set]
    refuse(Fault(Path(name), 0, 0, "is of native FMUs; add --native, or leave it out") for name in native_options)
    built = list(build_fmus(out, model, nearest=nearest, design=design, tell=warn))
    for path in built:
        say(f"built {path}")
    if as_json:
        say_json({"built": [{"fmu": str(path)} for path in built]})
