"""Reading a scenario file: overrides, faults with their place, and what is left of a faulty one to check on."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from cosim.errors import Fault, InputError
from cosim.simulation.scenario import Scenario
from cosim.yaml_file import YamlFile, plain

MOST_STEPS = 2e7
ROUNDING = 1e-9  # relative slack when a duration is divided into steps


class ScenarioFile:
    """A scenario and the file it came from, so that later checks can name the place.

    Faults of form do not stop the checks of meaning: `faults` holds them, `scenario` what is left without the
    faulty parts, `broken` the names of components left out. Whoever runs a scenario raises `faults` first.
    """

    def __init__(self, path: Path, overrides: Sequence[str] = ()) -> None:
        self.path = path
        self.yaml = YamlFile(path)
        data = plain(self.yaml.root)
        self.manifest: Mapping[str, Any] | None = None
        if isinstance(data.get("scenario"), dict) and "schema_version" in data:
            self.manifest, data = data, data["scenario"]
            self.yaml.root = self.yaml.root["scenario"]
        for override in overrides:
            _override(path, data, override)
        self.broken: set[str] = set()
        self.stands_in = False
        self.connection_lines = _numbered(data.get("connections"))
        self.faults: list[Fault] = []
        self.scenario = self._validate(data)
        self.faults += [*self._step_faults(), *self._criteria_faults()]

    def _validate(self, data: dict[str, Any]) -> Scenario:
        """The scenario; where it has faults of form, what is left without them."""
        try:
            return self.yaml.validate(Scenario, data)
        except InputError as error:
            self.faults += error.faults
        left = Salvage(data)
        for _ in range(3):  # what is left may miss a key it needs
            try:
                scenario = Scenario.model_validate(left.data)
            except ValidationError as error:
                left.drop([e["loc"] for e in error.errors()])
            else:
                self.broken, self.connection_lines = left.broken, left.connection_lines
                self.stands_in = left.stands_in
                return scenario
        raise InputError(self.faults)

    def resolve(self, name: str) -> Path:
        """A file named in the scenario, relative to the scenario's own folder."""
        return (self.path.parent / name).resolve()

    @property
    def files(self) -> list[Path]:
        """FMUs and recordings that its components name."""
        named = ((getattr(c, "fmu", None) or getattr(c, "file", None)) for c in self.scenario.components.values())
        return [self.resolve(name) for name in named if name]

    def fault(self, location: tuple[str | int, ...], message: str, exit_code: int = 2) -> Fault:
        """A fault at a place of the scenario."""
        return self.yaml.fault(location, message, exit_code=exit_code)

    def _step_faults(self) -> list[Fault]:
        s = self.scenario
        if self.stands_in:  # duration or step is faulty itself
            return []
        count = s.duration / s.step
        if not count <= MOST_STEPS:
            message = f"step is {s.step:g} s: {count:.3g} steps are more than the {MOST_STEPS:g} a run may have"
            return [self.fault(("step",), message)]
        if abs(count - round(count)) <= ROUNDING * max(1.0, count) and round(count) >= 1:
            return []
        cure = s.duration / max(1, math.ceil(count))
        return [
            self.fault(
                ("step",),
                f"step is {s.step:g} s; use a whole divisor of duration {s.duration:g} s, {cure:.6g} s for one",
            )
        ]

    def _criteria_faults(self) -> list[Fault]:
        faults = []
        for kind, k, criterion in self.scenario.goals:
            where: tuple[str | int, ...] = ("criteria", kind, *(() if k is None else (k,)))
            if (kind == "settling_time") != (criterion.band is not None):
                faults.append(
                    self.fault(where, f"{kind} needs a band" if kind == "settling_time" else f"{kind} takes no band")
                )
            end = self.scenario.duration if criterion.until is None else criterion.until
            if not 0 <= criterion.after < end <= self.scenario.duration or end - criterion.after < self.scenario.step:
                faults.append(
                    self.fault(
                        where,
                        f"{kind} looks from {criterion.after:g} s to {end:g} s of {self.scenario.duration:g} s",
                    )
                )
        return faults


STAND_INS: dict[str, Any] = {"name": "?", "duration": 1.0, "step": 0.1}


class Salvage:
    """A scenario's data without its faulty parts, so that the rest can still be checked for meaning."""

    def __init__(self, data: dict[str, Any]) -> None:
        self.data = copy.deepcopy(data)
        self.broken: set[str] = set()
        self.connection_lines = _numbered(data.get("connections"))
        self.stands_in = False

    def drop(self, locations: Sequence[tuple[int | str, ...]]) -> None:
        """Leave out the part at each location, as little as will do."""
        connections: set[int] = set()
        for first, *rest in locations:
            if first == "connections" and rest and isinstance(rest[0], int):
                connections.add(rest[0])
            elif first == "components" and rest:
                self._drop_from_component(str(rest[0]), [p for p in rest[1:] if not str(p).endswith("»")])
            elif first == "criteria" and rest:
                self.data["criteria"].pop(rest[0], None)
            elif first in STAND_INS:
                self.data |= STAND_INS
                self.stands_in = True
            else:
                self.data.pop(str(first), None)
        if connections:
            kept = [k for k in range(len(self.data["connections"])) if k not in connections]
            self.data["connections"] = [self.data["connections"][k] for k in kept]
            self.connection_lines = [self.connection_lines[k] for k in kept]

    def _drop_from_component(self, name: str, rest: list[int | str]) -> None:
        component = self.data["components"].get(name)
        if isinstance(component, dict) and len(rest) == 1 and rest[0] in component and rest[0] not in {"fmu", "block"}:
            del component[rest[0]]
        elif isinstance(component, dict) and len(rest) == 2 and rest[0] == "start":
            component["start"].pop(rest[1], None)
        else:
            self.data["components"].pop(name, None)
            self.broken.add(name)
            if not self.data["components"]:
                self.data["components"] = {"_": {"block": "reference", "signals": {"_": {}}}}


def _numbered(connections: Any) -> list[int]:
    """Places of the connections in the file."""
    return list(range(len(connections))) if isinstance(connections, list) else []


def _place(key: str, node: list[Any]) -> int | None:
    """A key as the place of an item that is there."""
    return int(key) if key.isascii() and key.isdigit() and int(key) < len(node) else None


def _override(path: Path, data: dict[str, Any], text: str) -> None:
    """Put one `path=value` into the data; the value is read as YAML (JSON included)."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    target, sign, value = text.partition("=")
    if not sign or not target.strip():
        raise InputError([Fault(path, 0, 0, f'--set "{text}" is not path=value; for example --set noise=off')])
    try:
        parsed = plain(YAML(typ="safe", pure=True).load(value))
    except YAMLError:
        parsed = value
    node: Any = data
    keys = target.strip().split(".")
    # a variable's name may hold dots itself: components.plant.start.coulomb_friction.force
    if len(keys) > 4 and keys[0] == "components" and keys[2] == "start":
        keys = [*keys[:3], ".".join(keys[3:])]
    for key in keys[:-1]:
        if isinstance(node, list) and _place(key, node) is not None:
            node = node[_place(key, node) or 0]
        elif isinstance(node, dict):
            node = node.setdefault(key, {})
        else:
            raise InputError([Fault(path, 0, 0, f'--set "{text}": there is no {target} in the scenario')])
    if isinstance(node, dict):
        node[keys[-1]] = parsed
    elif isinstance(node, list) and _place(keys[-1], node) is not None:
        node[_place(keys[-1], node) or 0] = parsed
    else:
        raise InputError([Fault(path, 0, 0, f'--set "{text}": there is no {target} in the scenario')])
