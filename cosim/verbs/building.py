"""The commands that build and export: build and export-ssp."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cosim.core.errors import Fault, refuse
from cosim.core.messages import Note
from cosim.verbs.cli import say, say_json, warn


def build_command(*, json: bool = False, **given: Any) -> None:
    """Build the FMUs of a model.

    Args:
        folder (--out -o PATH): Folder for the FMUs.
        model (MODEL): Build this model: a registered one, a model.yaml, the folder of a refine, or FILE.py:CLASS.
        design (--design FILE): Design the model's controller with the weights and numbers in this YAML file.
        platforms (NAME,NAME): Platforms of native FMUs (default: this machine).

    Example: cosim build --model results/refine/model.yaml --out build/refined
    """
    given["platforms"] = [p.strip() for text in given["platforms"] for p in text.split(",") if p.strip()]
    if given.pop("native"):
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
    """Write a scenario as an SSP 1.0 for other simulators.

    Noise is off; references become FMUs.

    Args:
        path (--out -o PATH): SSP file (default: NAME.ssp in the current folder).
        overrides (--set PATH=VALUE): Replace a value of the scenario, for example noise=off.

    Example: cosim export-ssp scenario.yaml --out system.ssp
    """
    from cosim.authoring.export import export_ssp

    exported = export_ssp(**given)
    warn(*map(Note, exported.notes))
    say(f"wrote {exported.path}")
    if json:
        say_json({"ssp": str(exported.path), "notes": list(exported.notes)})
