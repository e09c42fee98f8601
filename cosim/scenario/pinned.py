"""Files of a run that is repeated: those whose content the manifest holds, where they were or beside it."""

from __future__ import annotations

import hashlib
from pathlib import Path, PureWindowsPath
from typing import Any

from cosim.scenario.scenario import Component, FmuComponent, Scenario


def sha256(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def key_of(component: Component) -> str:
    """Under which key a component names its file."""
    return "fmu" if isinstance(component, FmuComponent) else "file"


def with_files_beside(scenario: Scenario, folder: Path) -> Scenario:
    """The scenario of a manifest in `folder`, which takes from there, by name, a file that is not at its place.

    One that is there with another content gives way too where that in the folder is the one of the run.
    """
    components: dict[str, Any] = {}
    for name, component in scenario.components.items():
        key = key_of(component)
        pinned, named = getattr(component, "sha256", None), getattr(component, key, None)
        beside = folder / PureWindowsPath(named or "").name  # of a path of any system
        if pinned is None or not named or not beside.is_file():
            continue
        there = folder / named
        if not there.is_file() or (sha256(there) != pinned and sha256(beside) == pinned):
            components[name] = component.model_copy(update={key: beside.name})
    return scenario.model_copy(update={"components": {**scenario.components, **components}}) if components else scenario
