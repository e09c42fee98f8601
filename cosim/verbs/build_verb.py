"""`cosim build`: build FMUs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.base.errors import Fault, InputError
from cosim.verbs.options import Json
from cosim.verbs.terminal import say, say_json

Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for what the command leaves; made if missing.")]


def command(
    out: Out = Path("build"),
    *,
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
