"""Reading of scenario files: overrides, faults with line and column, and the valid parts of a faulty file."""

from __future__ import annotations

import copy
import hashlib
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import reduce
from itertools import islice
from operator import getitem
from pathlib import Path, PureWindowsPath
from typing import Any

from cosim.core.errors import Fault, InputError
from cosim.core.text import did_you_mean
from cosim.core.times import STEP_COUNT_TOLERANCE
from cosim.files.artefact import MANIFEST, SCENARIO, kind_by_keys
from cosim.files.folders import other_version
from cosim.files.kinds import check_form, refuse_other
from cosim.files.yaml_file import Document, Location, NotYaml, Origin, YamlFile, remove_part, short
from cosim.scenario.scenario import Component, FmuComponent, Recording, Scenario, ValidCriterion
from cosim.scenario.start_values import STAND_IN, waiting_texts

MAX_RUN_STEPS = 2e7
FILE_KEYS = ("fmu", "file", "parameters")  # keys of file names of a component
SYSTEM = "system"  # folder with scenario and FMUs in the run folder of an SSP
LISTS = ("connections", "faults", "events")  # lists from which single faulty entries are removed
STAND_INS: dict[str, Any] = {"name": "?", "duration": 1.0, "step": 0.1}
TICKS = 1000  # least ratio of the shortest controlled step to the spacing of doubles at the largest time


class ScenarioFile:
    """A scenario with its file, so that later checks can name line and column.

    Keys or types with faults do not prevent further checks. Before a run, the caller must raise `faults`.

    Args:
        overrides: `path=value` texts; the message on a fault of an overridden value names the override.
        origin: Function that maps a fault of a generated scenario to its source file.
        option: Name of the option in messages on overrides; "" if the caller supplies the places.

    Attributes:
        overrides: The `path=value` texts.
        faults: Faults so far.
        scenario: Scenario without its faulty parts.
        broken: Names of removed components.
        places: Indices in the file of the remaining connections, faults and events.
        sets: Component → files of its parameter sets; their values are already in its start values.
    """

    scenario: Scenario

    def __init__(
        self, path: Path, overrides: Sequence[str] = (), origin: Origin | None = None, option: str = "--set"
    ) -> None:
        self.path, self.overrides = path, [str(override) for override in overrides]
        self._paths: dict[str, Path] = {}  # of files by their names in the scenario
        check_form(path, SCENARIO, MANIFEST)
        self.yaml = YamlFile(path, origin)
        kind = kind_by_keys(self.yaml.root)
        refuse_other(path, kind, SCENARIO, MANIFEST)
        self.manifest: Mapping[str, Any] | None = None
        if isinstance(self.yaml.root.get("scenario"), dict) and kind == MANIFEST:
            self.manifest = self.yaml.root
            self.yaml.enter("scenario")
        data = copy.deepcopy(self.yaml.root)
        for override in overrides:
            subject = f'{option} "{short(override)}"' if option else ""
            self.yaml.overrides[_override(path, data, override, subject)] = subject
        self.faults: list[Fault] = []
        self.warnings = [*other_version(path, self.manifest or {})]  # faults in valid parts of the scenario
        form_faults = self._read(data)
        texts = [*waiting_texts(self.scenario, self.places, self.resolve)]
        for at, text, number_of in texts:
            part = reduce(getitem, at[:-1], data)
            try:
                part[at[-1]] = number_of(text)
            except ValueError as error:
                part[at[-1]] = STAND_IN
                self.faults.append(self.yaml.wrong(at, text, error))
        if texts:
            form_faults = self._read(data)  # before conversion, since ranges apply to numbers
        self.faults += form_faults
        self.sets: dict[str, list[Path]] = {}
        self._take_parameter_sets()
        if self.manifest is not None:
            self.scenario = with_files_beside(self.scenario, path.parent)
        self.faults += [self.fault(where, message) for where, message in self._time_faults()]

    def _read(self, data: dict[str, Any]) -> list[Fault]:
        """Set the scenario without its faulty parts; return the faults of keys and types."""
        self.broken, self.stands_in = set[str](), False  # the latter is True if name, duration or step were replaced
        lists = {key: data[key] if isinstance(data.get(key), list) else () for key in LISTS}
        self.places = {key: list(range(len(entries))) for key, entries in lists.items()}
        self.scenario, faults = self.yaml.partly(Scenario, data=data, remove=self._drop)
        return faults

    def _drop(self, data: dict[str, Any], places: Sequence[tuple[Location, str]]) -> None:
        """Remove the smallest part around each fault, so that the other parts can be checked."""
        entries: dict[Any, set[Any]] = {}
        for (first, *rest), _ in places:
            if first in STAND_INS:
                data |= STAND_INS
                self.stands_in = True
            elif first in LISTS and rest:
                entries.setdefault(first, set()).add(rest[0])
            else:
                part, key = remove_part(data, (first, *rest))
                if part is data.get("components"):
                    self.broken.add(str(key))
        if not data.get("components", True):
            data["components"] = {"_": {"block": "reference", "signals": {"_": {}}}}
        for key, faulty in entries.items():
            parts: tuple[dict[str, Any], ...] = (data, self.places)
            for part in parts:
                part[key] = [entry for k, entry in enumerate(part[key]) if k not in faulty]

    def _take_parameter_sets(self) -> None:
        """Add the values of parameter sets to the start values of their components."""
        components: dict[str, Any] = {}
        for name, component in self.scenario.components.items():
            if not isinstance(component, FmuComponent) or not component.parameters:
                continue
            from cosim.ssp.read import read_parameter_set

            named = [component.parameters] if isinstance(component.parameters, str) else component.parameters
            self.sets[name], values = [self.resolve(file) for file in named], dict[str, Any]()
            for k, path in enumerate(self.sets[name]):
                try:
                    read = read_parameter_set(path)
                except InputError as error:
                    is_there = path.is_file()
                    at = ("components", name, "parameters", *(() if isinstance(component.parameters, str) else (k,)))
                    self.faults += error.faults if is_there else [self.fault(at, f"no such file: {path}")]
                    continue
                for p in read:  # a value with a unit is text, which is converted to the unit of the FMU variable
                    has_unit = p.unit and not isinstance(p.value, (bool, str))
                    values[p.name] = f"{p.value!r} {p.unit}" if has_unit else p.value
            start = {**values, **component.start}
            components[name] = component.model_copy(update={"start": start, "parameters": []})
        if components:
            self.scenario = self.scenario.model_copy(update={"components": {**self.scenario.components, **components}})

    def resolve(self, name: str) -> Path:
        """Return a file's path relative to the scenario's folder."""
        if name not in self._paths:
            self._paths[name] = path = self.path.parent / name
            with suppress(OSError, ValueError):  # a loop of links, or a zero byte
                self._paths[name] = path.resolve()
        return self._paths[name]

    def component_files(self) -> Iterator[tuple[str, str, Path]]:
        """Yield component, key and path of each FMU and recording."""
        for name, component in self.scenario.components.items():
            key = key_of(component)
            if file := getattr(component, key, None):
                yield name, key, self.resolve(file)

    @property
    def files(self) -> list[Path]:
        """Return the FMUs, recordings and parameter sets of the components."""
        files = [path for _, _, path in self.component_files()]
        return files + [path for paths in self.sets.values() for path in paths]

    def fault(self, location: Location, message: str, exit_code: int = 2) -> Fault:
        """Return a fault at a place of the scenario."""
        name, variable = (location[1], location[3]) if len(location) > 3 and location[2] == "start" else ("", "")
        if sets := self.sets.get(str(name)):
            written = self.yaml.root.get("components", {}).get(name, {}).get("start") or {}
            if variable not in written:
                location = ("components", name, "parameters")
                message = f"{', '.join(path.name for path in sets)}: {message}"
        return self.yaml.fault(location, message, exit_code=exit_code)

    def _time_faults(self) -> Iterator[tuple[Location, str]]:
        """Yield places and faults of times that contradict each other."""
        s, control, overrides = self.scenario, self.scenario.control, self.yaml.overrides
        of_control = [*self._control_faults()]
        yield from of_control
        count = s.duration / s.step
        if of_control or self.stands_in:  # Otherwise duration or step is faulty itself.
            pass
        elif not count <= MAX_RUN_STEPS:
            number = f"which makes {count:.3g} steps; a run may have at most {MAX_RUN_STEPS:g}"
            cure = "give a longer step or a shorter duration"
            yield ("step",), f"step is {s.step:g} s, {number}; {cure}"
        elif not is_whole(count):
            where: Location = ("step",)
            if control is not None:
                where = ("step", "max" if control.rows is None else "rows")
            elif ("duration",) in overrides and ("step",) not in overrides:
                where = ("duration",)
            divisor = s.duration / max(1, math.ceil(count))
            text = f"duration {s.duration:g} s is not a multiple of step {s.step:g} s; use for example step"
            yield where, f"{text} {divisor:.6g} s"
        every = s.record.every if isinstance(s.record, Recording) and not self.stands_in else None
        if every and not (is_whole(every / s.step) and every <= s.duration * (1.0 + STEP_COUNT_TOLERANCE)):
            message = f"{every:g} s is not a whole number of steps within the run; use for example {s.step:g} s"
            yield ("record", "every"), message
        for kind, where, goal in s.every_goal:
            if (kind == "valid") != isinstance(goal, ValidCriterion):
                of_region = "valid needs a component and its least share of time, as in {of: plant, min: 0.95}"
                yield where, of_region if kind == "valid" else f"{kind} takes no min; give the largest value as max"
        for kind, where, criterion in s.goals:
            if (kind == "settling_time") != (criterion.band is not None):
                yield where, "settling_time, and no other kind, needs a band: the allowed distance from its target"
            start, end = criterion.after, s.duration if criterion.until is None else criterion.until
            is_inside = self.stands_in or (start < end <= s.duration and end - start >= s.step)
            if start < 0 or not is_inside:
                interval = f"{kind} is evaluated from {start:g} s to {end:g} s of a run of {s.duration:g} s"
                yield where, f"{interval}; choose times within the run, at least one step apart"

    def _control_faults(self) -> Iterator[tuple[Location, str]]:
        """Yield places and faults of the settings of error-controlled steps."""
        s, control = self.scenario, self.scenario.control
        if control is None or self.stands_in:
            return
        least = TICKS * math.ulp(abs(s.start_time) + s.duration)
        if not control.min <= control.max <= s.step * (1.0 + STEP_COUNT_TOLERANCE):
            times = f"min is {control.min:g} s, max {control.max:g} s and rows {s.step:g} s"
            key = "min" if control.min > control.max else "max"
            yield ("step", key), f"{times}; min must not exceed max, and max must not exceed rows"
        if control.min < least:
            yield ("step", "min"), f"min is {control.min:g} s, too short for doubles at these times; give {least:.2g} s"
        if control.estimator is not None and bool(control.bonds) != (control.estimator == "energy"):
            message = "estimator: energy, and no other, needs bonds: [{effort: a.force, flow: b.velocity}]"
            yield ("step", "estimator"), message


def is_whole(count: float) -> bool:
    """Return True if a number of steps is a whole number of at least 1, within rounding."""
    return abs(count - round(count)) <= STEP_COUNT_TOLERANCE * max(1.0, count) and round(count) >= 1


def _override(path: Path, data: dict[str, Any], text: str, subject: str) -> Location:
    """Apply a `path=value` override; return the location of the value.

    The value is read as YAML (which includes JSON); if that fails, as text.

    Args:
        subject: Name of the override in messages; "" for its path as name.
    """
    target, sign, value = text.partition("=")
    reason = "does not have the form path=value; for example --set noise=off"
    if sign and target.strip():
        node: Any = data
        keys = keys_of(target.strip())
        components = data.get("components")
        if len(keys) > 1 and keys[0] not in data and isinstance(components, dict) and keys[0] in components:
            keys = ["components", keys[0], "start", target.strip().partition(".")[2]]  # a variable's name
        at: list[str | int] = []
        for depth, key in enumerate(keys):
            index: str | int = key
            if isinstance(node, list) and key.isascii() and key.isdigit() and int(key) < len(node):
                index = int(key)
            elif not isinstance(node, dict) or (key not in node and depth == 1 and keys[0] == "components"):
                break
            at.append(index)
            if len(at) == len(keys):
                try:
                    node[index] = from_here(keys, Document(value).data)
                except NotYaml:
                    node[index] = from_here(keys, value)
                return tuple(at)
            node = node.setdefault(index, {}) if isinstance(node, dict) else node[index]
        names = [*map(short, islice(components, 20))] if isinstance(components, dict) else []
        reason = f"cannot be set: the scenario has no {short(target)} (its components: {', '.join(names)})"
        reason += did_you_mean(keys[1], names) if keys[0] == "components" else ""
    raise InputError.at(path, f"{subject or short(target)} {reason}")


def keys_of(target: str) -> list[str]:
    """Return the keys of a path in the scenario.

    A variable's name may contain dots: components.plant.start.coulomb_friction.force.
    """
    keys = target.split(".")
    if len(keys) > 4 and keys[0] == "components" and keys[2] == "start":
        return [*keys[:3], ".".join(keys[3:])]
    return keys


def from_here(keys: Sequence[str], value: Any) -> Any:
    """Return a part of a scenario in which file names are absolute.

    A relative name refers to the current folder, in which the user typed it.

    Args:
        keys: Keys of the part; empty for the whole scenario.
    """
    if keys and keys[0] != "components":
        return value
    if len(keys) < 3 and isinstance(value, Mapping):
        return {key: from_here([*keys, str(key)], part) for key, part in value.items()}
    is_file = len(keys) == 3 and keys[2] in FILE_KEYS and isinstance(value, str) and value != ""
    return os.path.abspath(value) if is_file else value


# -- files of a repeated run, which must have the content hash in the manifest ---------------------


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def key_of(component: Component) -> str:
    """Return the key of a component that contains its file name: `fmu` or `file`."""
    return "fmu" if isinstance(component, FmuComponent) else "file"


def with_files_beside(scenario: Scenario, folder: Path) -> Scenario:
    """Return the scenario of a manifest, in which copies in `folder` replace missing or changed files.

    A missing file is searched by name in `folder`, and in the system of an SSP in it. A changed file is replaced if the
    file in `folder` has the recorded hash.
    """
    components: dict[str, Any] = dict(scenario.components)
    for name, component in components.items():
        key = key_of(component)
        pinned, named = getattr(component, "sha256", None), getattr(component, key, None)
        file = PureWindowsPath(named or "").name  # file name from a path of any operating system
        beside = next((each for each in (file, f"{SYSTEM}/{file}") if (folder / each).is_file()), "")
        if pinned is not None and named and beside:
            original = folder / named
            if not original.is_file() or (sha256(original) != pinned and sha256(folder / beside) == pinned):
                components[name] = component.model_copy(update={key: beside})
    return scenario.model_copy(update={"components": components})
