"""Reading scenario files: overrides, faults with their place, and the valid remainder of a faulty file."""

from __future__ import annotations

import copy
import hashlib
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from functools import reduce
from itertools import islice
from operator import getitem
from pathlib import Path, PureWindowsPath
from typing import Any

from pydantic import ValidationError

from cosim.core.errors import Fault, InputError, refuse
from cosim.files.artefact import MANIFEST, SCENARIO, kind_by_keys
from cosim.files.folders import SCHEMA_VERSION, other_version
from cosim.files.kinds import check_form, refuse_other
from cosim.files.yaml_file import MOST_FAULTS, Origin, YamlFile, did_you_mean, location_in, short
from cosim.files.yaml_nodes import Document, Location, NotYaml
from cosim.fmi.building.refined import NEAREST, REFINED, NoNearest, folder_of, names_refine, refined_file
from cosim.scenario.scenario import Component, FmuComponent, Recording, Scenario, StepControl
from cosim.scenario.signal_units import STAND_IN, waiting_texts

MOST_STEPS = 2e7
ROUNDING = 1e-9  # relative tolerance for a whole number of steps
SYSTEM = "system"  # folder with scenario and FMUs in the run folder of an SSP
LONGEST = 2000  # of a message [characters]
Place = tuple[str | int, ...]  # keys of a part of the scenario
LISTS = ("connections", "faults", "events")  # lists from which faulty entries are removed singly
STAND_INS: dict[str, Any] = {"name": "?", "duration": 1.0, "step": 0.1}
TICKS = 1000  # spacings of floating-point times in the shortest controlled step


class ScenarioFile:
    """A scenario with its file, so that later checks can name places.

    Faults of form do not stop the checks of meaning. Callers that run the scenario must raise `faults` first.

    Args:
        overrides: `path=value` texts; a fault of such a value names the override.
        origin: Maps faults to the source file of a generated scenario.
        option: Option name for messages on overrides; "" if the caller supplies places.

    Attributes:
        faults: Faults so far.
        scenario: Scenario without its faulty parts.
        broken: Names of removed components.
        places: Indices in the file of the remaining connections, faults and events.
    """

    def __init__(
        self, path: Path, overrides: Sequence[str] = (), origin: Origin | None = None, option: str = "--set"
    ) -> None:
        self.path = path
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
        self.warnings: list[str] = []  # about valid parts of the scenario
        if self.manifest is not None and "schema_version" not in self.manifest:
            self.warnings.append(
                f"{path} is a manifest without schema_version, as after an edit; it is read as one of version "
                f"{SCHEMA_VERSION}"
            )
        self.warnings += other_version(path, self.manifest or {})
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
            form_faults = self._read(data)  # Ranges hold for numbers.
        self.faults += form_faults
        if self.manifest is not None:
            self.scenario = with_files_beside(self.scenario, path.parent)
        self.faults += [self.fault(where, message) for where, message in self._time_faults()]

    def _read(self, data: dict[str, Any]) -> list[Fault]:
        """Set the scenario, without faulty parts if necessary; return the faults of form."""
        self.broken, self.stands_in = set[str](), False  # whether name, duration or step are replaced
        lists = {key: data[key] if isinstance(data.get(key), list) else () for key in LISTS}
        self.places = {key: list(range(len(entries))) for key, entries in lists.items()}
        try:
            self.scenario = self.yaml.validate(Scenario, data)
            return []
        except InputError as error:
            faults = [*error.faults]
        data = copy.deepcopy(data)
        for _ in range(3):  # The remainder may lack a required key.
            try:
                self.scenario = Scenario.model_validate(data)
                return faults
            except ValidationError as error:
                found = error.errors(include_url=False)
                self._drop(data, [location_in(data, e["loc"], e["type"]) for e in found])
        raise InputError(faults)

    def _drop(self, data: dict[str, Any], locations: Sequence[tuple[int | str, ...]]) -> None:
        """Remove the smallest part around each location, so that the rest can be checked."""
        entries: dict[str, set[int]] = {}
        for first, *rest in filter(None, locations):
            if first in LISTS and rest and isinstance(rest[0], int):
                entries.setdefault(str(first), set()).add(rest[0])
            elif first == "components" and rest:
                self._drop_from_component(data["components"], str(rest[0]), rest[1:])
            elif first == "criteria" and rest:
                data["criteria"].pop(rest[0], None)
            elif first in STAND_INS:
                data |= STAND_INS
                self.stands_in = True
            else:
                data.pop(str(first), None)
        for key, faulty in entries.items():
            parts: tuple[dict[str, Any], ...] = (data, self.places)
            for part in parts:
                part[key] = [entry for k, entry in enumerate(part[key]) if k not in faulty]

    def _drop_from_component(self, components: dict[str, Any], name: str, rest: list[int | str]) -> None:
        component = components.get(name)
        start = component.get("start") if isinstance(component, dict) else None
        if isinstance(component, dict) and len(rest) == 1 and rest[0] in component and rest[0] not in {"fmu", "block"}:
            del component[rest[0]]
        elif isinstance(start, dict) and len(rest) == 2 and rest[0] == "start":
            start.pop(rest[1], None)
        else:
            components.pop(name, None)
            self.broken.add(name)
            if not components:
                components["_"] = {"block": "reference", "signals": {"_": {}}}

    def resolve(self, name: str) -> Path:
        """Return a file's path relative to the scenario's folder."""
        path = self.path.parent / name
        try:
            return path.resolve()
        except (OSError, ValueError):  # a loop of links, or a zero byte
            return path

    @property
    def files(self) -> list[Path]:
        """Return the FMUs and recordings of the components."""
        every = self.scenario.components.values()
        names = ((getattr(c, "fmu", None) or getattr(c, "file", None)) for c in every)
        return [self.resolve(name) for name in names if name]

    def fault(self, location: Location, message: str, exit_code: int = 2) -> Fault:
        """Return a fault at a place of the scenario."""
        return self.yaml.fault(location, message, exit_code=exit_code)

    def _time_faults(self) -> Iterator[tuple[Location, str]]:
        """Yield places and faults of times that contradict each other."""
        s = self.scenario
        if not self.stands_in:  # Otherwise duration or step is faulty itself.
            control = [] if s.control is None else [*self._control_faults(s.control)]
            yield from control or self._step_faults()
            if isinstance(s.record, Recording) and (every := s.record.every) is not None:
                steps, at = every / s.step, ("record", "every")
                if every > s.duration * (1.0 + ROUNDING):
                    yield at, f"{every:g} s is longer than the run, {s.duration:g} s; use a shorter time"
                elif not _is_whole(steps):
                    near = " or ".join(f"{n * s.step:.6g} s" for n in (math.floor(steps), math.ceil(steps)) if n)
                    yield at, f"{every:g} s is no whole number of steps of {s.step:g} s; use for example {near}"
        for kind, k, criterion in s.goals:
            where: Location = ("criteria", kind, *(() if k is None else (k,)))
            if kind == "settling_time" and criterion.band is None:
                yield where, f"{kind} needs a band; add the allowed distance from its target"
            elif kind != "settling_time" and criterion.band is not None:
                yield where, f"{kind} takes no band; leave it out"
            start, end = criterion.after, s.duration if criterion.until is None else criterion.until
            is_inside = self.stands_in or (start < end <= s.duration and end - start >= s.step)
            if start < 0 or not is_inside:
                interval = f"{kind} looks from {start:g} s to {end:g} s of {s.duration:g} s"
                yield where, f"{interval}; choose times within the run, a step or more apart"

    def _step_faults(self) -> Iterator[tuple[Location, str]]:
        """Yield the fault of a duration that is no whole number of steps."""
        s, overrides = self.scenario, self.yaml.overrides
        count = s.duration / s.step
        if not count <= MOST_STEPS:
            steps = f"which makes {count:.3g} steps, and a run may have {MOST_STEPS:g}"
            yield ("step",), f"step is {s.step:g} s, {steps}; give a longer step or a shorter duration"
        elif not _is_whole(count):
            where: Location = ("step",)
            if s.control is not None:
                where = ("step", "max" if s.control.rows is None else "rows")
            elif ("duration",) in overrides and ("step",) not in overrides:
                where = ("duration",)
            divisor = s.duration / max(1, math.ceil(count))
            cure = f"use a whole divisor of duration {s.duration:g} s, {divisor:.6g} s for one"
            yield where, f"step is {s.step:g} s; {cure}"

    def _control_faults(self, control: StepControl) -> Iterator[tuple[Location, str]]:
        """Yield the faults of contradicting keys of `step`."""
        rows = control.max if control.rows is None else control.rows
        if not control.min <= control.max <= rows * (1.0 + ROUNDING):
            times = f"min is {control.min:g} s, max {control.max:g} s and rows {rows:g} s"
            key = "min" if control.min > control.max else "max"
            yield ("step", key), f"{times}; min is at most max, and max at most rows"
        least = TICKS * math.ulp(abs(self.scenario.start_time) + self.scenario.duration)
        if control.min < least:
            reason = "too short for floating-point times of this run"
            yield ("step", "min"), f"min is {control.min:g} s, {reason}; give at least {least:.2g} s"
        if control.bonds and control.estimator not in (None, "energy"):
            yield ("step", "bonds"), f"bonds belong to estimator: energy, not to {control.estimator}; leave one out"
        if control.estimator == "energy" and not control.bonds:
            yield ("step", "estimator"), "estimator: energy needs bonds: [{effort: a.force, flow: b.velocity}]"


class Diagnosis:
    """Collected faults and warnings, reported all at once; faults of form come first."""

    def __init__(self, file: ScenarioFile) -> None:
        self.file = file
        self.faults: list[Fault] = list(file.faults)
        self.warnings: list[str] = list(file.warnings)

    def note(self, where: Place, message: str, exit_code: int = 2) -> None:
        """Note a fault at a place of the scenario; raise InputError at the limit of faults."""
        if len(message) > LONGEST:
            message = f"{message[: LONGEST - 1]}…"
        self.faults.append(self.file.fault(where, message, exit_code=exit_code))
        if len(self.faults) >= MOST_FAULTS:
            raise InputError([*self.faults, Fault(self.file.path, 0, 0, f"the first {MOST_FAULTS} faults are shown")])

    def raise_any(self) -> None:
        """Raise InputError if any fault was noted."""
        refuse(self.faults)


def _is_whole(count: float) -> bool:
    """Return whether a number of steps is whole within rounding, and at least 1."""
    return abs(count - round(count)) <= ROUNDING * max(1.0, count) and round(count) >= 1


def _override(path: Path, data: dict[str, Any], text: str, subject: str) -> Location:
    """Apply a `path=value` override; return its place.

    The value is read as YAML, which includes JSON, else as text.

    Args:
        subject: The override in messages; "" for its path.
    """
    target, sign, value = text.partition("=")
    reason = "is not path=value; for example --set noise=off"
    if sign and target.strip():
        node: Any = data
        keys = keys_of(target.strip())
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
                    node[index] = _from_here(keys, Document(value).data)
                except NotYaml:
                    node[index] = _from_here(keys, value)
                return tuple(at)
            node = node.setdefault(index, {}) if isinstance(node, dict) else node[index]
        reason = f"leads nowhere: there is no {short(target)} in the scenario"
        if keys[0] == "components" and isinstance(components := data.get("components"), dict):
            some, hint = ", ".join(map(short, islice(components, 20))), did_you_mean(keys[1], components)
            reason = f'is for component "{short(keys[1])}", which is not in the scenario{hint} (its components: {some})'
    raise InputError.at(path, f"{subject or short(target)} {reason}")


def keys_of(target: str) -> list[str]:
    """Return the keys of a path.

    A variable's name may contain dots: components.plant.start.coulomb_friction.force.
    """
    keys = target.split(".")
    if len(keys) > 4 and keys[0] == "components" and keys[2] == "start":
        return [*keys[:3], ".".join(keys[3:])]
    return keys


FILES = ("fmu", "file")  # keys of file names of a component


def _from_here(keys: Sequence[str], value: Any) -> Any:
    """Return a value of --set with absolute file names.

    Relative names start at the current folder, where the user typed them.
    """
    if keys[0] != "components" or len(keys) not in {2, 3}:
        return value
    if len(keys) == 2:
        return {k: _from_here([*keys, str(k)], v) for k, v in value.items()} if isinstance(value, dict) else value
    return os.path.abspath(value) if keys[2] in FILES and isinstance(value, str) and value else value


def from_here(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return a fileless scenario with absolute file names."""
    scenario = dict(data)
    if isinstance(components := scenario.get("components"), Mapping):
        scenario["components"] = {
            name: _from_here(["components", str(name)], dict(c)) if isinstance(c, Mapping) else c
            for name, c in components.items()
        }
    return scenario


# -- files of a repeated run, which must have the content hash in the manifest ---------------------


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


# -- nearest models --------------------------------------------------------------------------------


def take_nearest(file: ScenarioFile) -> None:
    """Replace refined FMUs by the nearest, as `--nearest` asks. Failures become faults of the scenario file."""
    components: dict[str, Any] = dict(file.scenario.components)
    has_refined = False
    for name, component in components.items():
        if not isinstance(component, FmuComponent):
            continue
        path = file.resolve(component.fmu)
        if not folder_of(path) or not (path.name in (*REFINED, *NEAREST) or names_refine(path)):
            continue
        has_refined = True
        try:
            if component.sha256 is not None:
                raise NoNearest("a manifest repeats its run as it was; leave --nearest out, or run the scenario")
            components[name] = component.model_copy(update={"fmu": str(refined_file(path, nearest=True))})
        except NoNearest as error:
            file.faults.append(file.fault(("components", name, "fmu"), str(error)))
    if not has_refined:
        reason = "no component uses a result of `cosim refine`, so --nearest has no effect"
        file.faults.append(Fault(file.path, 0, 0, f"{reason}; name the FMU of such a result, or leave --nearest out"))
    file.scenario = file.scenario.model_copy(update={"components": components})
