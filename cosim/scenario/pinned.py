"""Files of a run that is repeated: those whose content the manifest holds, where they were or beside it."""

from __future__ import annotations

import hashlib
from pathlib import Path, PureWindowsPath
from typing import Any

from cosim.scenario.scenario import Component, FmuComponent, Scenario

SYSTEM = "system"  # within the folder of a run of an SSP: its scenario and FMUs


def sha256(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def key_of(component: Component) -> str:
    """Under which key a component names its file."""
    return "fmu" if isinstance(component, FmuComponent) else "file"


def with_files_beside(scenario: Scenario, folder: Path) -> Scenario:
    """The scenario of a manifest in `folder`, which takes a file that is not at its place from there, by name, or from
    the system of an SSP there.

    One that is there with another content gives way too where that in the folder is the one of the run.
    """
    components: dict[str, Any] = {}
    for name, component in scenario.components.items():
        key = key_of(component)
        pinned, named = getattr(component, "sha256", None), getattr(component, key, None)
        file = PureWindowsPath(named or "").name  # of a path of any system
        beside = next((each for each in (file, f"{SYSTEM}/{file}") if (folder / each).is_file()), "")
        if pinned is None or not named or not beside:
            continue
        there = folder / named
        if not there.is_file() or (sha256(there) != pinned and sha256(folder / beside) == pinned):
            components[name] = component.model_copy(update={key: beside})
    return scenario.model_copy(update={"components": {**scenario.components, **components}}) if components else scenario
