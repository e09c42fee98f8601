"""The manifest of a run: what is needed to understand the run and to repeat it bit for bit."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from cosim.core.errors import refuse
from cosim.core.messages import Note
from cosim.core.text import counted
from cosim.core.times import first_point
from cosim.core.units import is_as_known
from cosim.core.version import __version__
from cosim.files.folders import COMMAND_KEY, SCHEMA_VERSION
from cosim.fmi.description import ways
from cosim.master.observer import Change
from cosim.scenario.scenario import Scenario, resolve_defaults
from cosim.scenario.scenario_file import ScenarioFile, sha256
from cosim.system.system import System

RECORDED_PACKAGES = ("FMPy", "pythonfmu", "numpy", "scipy", "filterpy", "control", "pydantic")


def resolve_scenario(file: ScenarioFile, system: System) -> Scenario:
    """Return the scenario as executed, for the manifest.

    Paths are absolute, and each file has its hash. `pace` is left out, so that a repeated run is as fast as possible.
    """
    components = dict[str, Any](file.scenario.components)
    for name, key, named in file.component_files():
        path = system.fmus[name][0] if key == "fmu" else named
        components[name] = components[name].model_copy(update={key: str(path), "sha256": sha256(path)})
    return file.scenario.model_copy(update={"components": components, "pace": None})


def check_pinned(file: ScenarioFile) -> None:
    """Raise InputError if files differ from those that the manifest records by hash."""
    faults = []
    for name, key, path in file.component_files():
        pinned: str | None = getattr(file.scenario.components[name], "sha256", None)
        if pinned is not None and path.is_file() and sha256(path) != pinned:
            faults.append(
                file.fault(
                    ("components", name, key),
                    f"{path} is not the {'FMU' if key == 'fmu' else 'file'} of this run: its SHA-256 differs; "
                    "restore the file, or run the scenario instead of the manifest",
                )
            )
    refuse(faults)


def manifest(file: ScenarioFile, system: System, command: str = "") -> dict[str, Any]:
    """Return the manifest of a run before its outcome is known, without `software_versions`.

    Args:
        command: Command that created the scenario, unless it is `cosim run`.
    """
    scenario, recorded = resolve_scenario(file, system), system.recorded
    components: Mapping[str, Any] = scenario.components
    return {
        "schema_version": SCHEMA_VERSION,
        "cosim_version": __version__,
        **({COMMAND_KEY: command} if command else {}),
        "status": "ok",
        "date": datetime.now().astimezone().isoformat(timespec="seconds"),
        "set": file.overrides,
        "source": str(file.path.resolve()),
        "scenario": resolve_defaults(scenario),
        **({"real_time": {"pace": file.scenario.pace}} if file.scenario.pace is not None else {}),
        "seed": scenario.seed,
        "order": system.names,
        "held": [transfer.name for transfer in system.held if not transfer.of],
        "beside": [column for column in system.beside if column in recorded],
        **({"texts": texts} if (texts := sorted(system.texts & recorded)) else {}),
        "discrete": sorted(system.discrete & recorded),
        "units": {column: unit for column, unit in system.units.items() if unit and column in recorded},
        "display": {unit: [*shown] for unit, shown in system.display.items()},
        "unit_definitions": {
            column: list(signal.definition)
            for column, signal in system.signals.items()
            if signal.definition and column in recorded and not is_as_known(signal.unit, signal.definition)
        },
        "items": {c: dict(s.items) for c, s in system.signals.items() if s.items and c in recorded},
        "fmus": {
            name: {
                "path": str(path),
                "guid": description.guid,
                "sha256": components[name].sha256,
                "fmi_version": description.fmiVersion,
                "interface": components[name].interface or ways(description)[0],
                "model_name": description.modelName,
                "version": description.version,
                "generation_tool": description.generationTool,
            }
            for name, (path, description) in system.fmus.items()
        },
        **dict.fromkeys(("versions", "git")),  # filled later by `software_versions`
        "loop": "",
        "timings": {},
        "warnings": list(system.warnings),
        "criteria": [],
    }


def add_changes(record: dict[str, Any], scenario: Scenario, changes: Sequence[Change]) -> None:
    """Add changes by observers during a run to its manifest, as events at the same communication points.

    A repeated run thus sets the same values in the same order, and gives the same bytes.
    """
    if not changes:
        return
    events: list[dict[str, Any]] = record["scenario"].setdefault("events", [])
    made = []
    others: dict[int, list[dict[str, Any]]] = {}
    for event in events:
        others.setdefault(first_point(event["at"], scenario.start_time, scenario.step), []).append(event)
    for change in changes:
        at_point = others.setdefault(change.point, [])
        at = max([scenario.start_time + change.point * scenario.step, *(e["at"] for e in at_point)])
        values = {f"{name}.{variable}": v for name, values in change.values.items() for variable, v in values.items()}
        made.append({"at": at, "set": values})
        for event in at_point:  # of two events that set a variable, the later one, the change, remains
            if event["at"] == at:
                event["set"] = {name: values.get(name, value) for name, value in event["set"].items()}
        at_point.append({"at": at, "set": dict(values)})
        events.append(at_point[-1])
    record["changes"] = made
    record["warnings"].append(
        Note(
            f"{counted(len(made), 'change')} made during the run; the manifest records them as events, so it "
            "repeats the run"
        )
    )


def software_versions() -> dict[str, Any]:
    """Return the versions of the packages and the platform, and this package's git revision.

    The call is slow, because it starts git.
    """
    versions = {"python": platform.python_version(), "platform": platform.platform()}
    for package in RECORDED_PACKAGES:
        with suppress(PackageNotFoundError):
            versions[package.lower()] = version(package)
    git, folder = None, Path(__file__).resolve().parent.parent
    if (folder / ".git").exists():
        command = ["git", "-C", str(folder), "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty"]
        with suppress(OSError, subprocess.SubprocessError):
            text = subprocess.check_output(command, stderr=subprocess.DEVNULL, text=True, timeout=10).strip()
            git = {"revision": text.removesuffix("-dirty"), "dirty": text.endswith("-dirty")}
    return {"versions": versions, "git": git}
