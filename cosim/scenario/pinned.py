"""Files of a repeated run, which must have the content hash in the manifest.

A file is searched at its path, then beside the manifest.
"""

from __future__ import annotations

import hashlib
from pathlib import Path, PureWindowsPath
from typing import Any

from cosim.scenario.scenario import Component, FmuComponent, Scenario

SYSTEM = "system"  # folder with scenario and FMUs in the run folder of an SSP


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def key_of(component: Component) -> str:
    """Return the key for a component's file."""
    return "fmu" if isinstance(component, FmuComponent) else "file"


def with_files_beside(scenario: Scenario, folder: Path) -> Scenario:
    """Return a manifest's scenario with missing or changed files replaced by those beside the manifest.

    A file missing at its path is taken by name from `folder` or from the system of an SSP there. A file with different
    content is replaced too, if the file in `folder` has the content of the run.
    """
    components: dict[str, Any] = {}
    for name, component in scenario.components.items():
        key = key_of(component)
        pinned, named = getattr(component, "sha256", None), getattr(component, key, None)
        file = PureWindowsPath(named or "").name  # file name from a path of any operating system
        substitute = next((each for each in (file, f"{SYSTEM}/{file}") if (folder / each).is_file()), "")
        if pinned is None or not named or not substitute:
            continue
        original = folder / named
        if not original.is_file() or (sha256(original) != pinned and sha256(folder / substitute) == pinned):
            components[name] = component.model_copy(update={key: substitute})
    return scenario.model_copy(update={"components": {**scenario.components, **components}}) if components else scenario
