"""Scenario files: what is run, how it is connected, what it must achieve."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    field_validator,
)

from cosim.errors import Fault, InputError
from cosim.yaml_file import YamlFile, plain

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0)]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
Variable = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*\.\S+$")]
ROUNDING = 1e-9  # relative slack when a duration is divided into steps


def _scalar(value: Any) -> Any:
    """A start value: a finite number, true or false, or text (a number with a unit, or the value of a string)."""
    if isinstance(value, (bool, str)) or (isinstance(value, (int, float)) and math.isfinite(value)):
        return value
    raise ValueError("a start value is a finite number, true or false, or text such as 12 deg")


def _kind_of(component: Any) -> str | None:
    """Which kind of component a mapping describes, by the key that only this kind has."""
    if isinstance(component, FmuComponent | ReferenceComponent | PlaybackComponent):
        return f"«{getattr(component, 'block', 'fmu')}»"
    if not isinstance(component, dict):
        return None
    block = component.get("block")
    return f"«{block}»" if block in BLOCKS else "«fmu»" if "fmu" in component else None


BLOCKS = ("reference", "playback")


class Part(BaseModel):
    """A part of a scenario: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)


class Noise(Part):
    """Gaussian noise and bias that a connection adds, in the square of the signal's unit and in its unit."""

    variance: NotNegative = 0.0
    bias: Number = 0.0


class Connection(Part):
    """From one output to one input, `component.variable`."""

    source: Variable = Field(alias="from")
    target: Variable = Field(alias="to")
    noise: Noise | None = None


class FmuComponent(Part):
    """An FMU and the start values it is given, a number in the variable's unit or text such as `12 deg`."""

    fmu: str
    start: dict[str, Annotated[Any, AfterValidator(_scalar)]] = {}
    sha256: str | None = None


class Change(Part):
    """A reference goes `to` a value `at` a time [s]: a step, or a ramp at `rate` a second."""

    at: NotNegative
    to: Number
    rate: Positive | None = None


class Profile(Part):
    """A reference over time: a start value and changes in order."""

    unit: str = ""
    start: Number = 0.0
    changes: list[Change] = []

    @field_validator("changes")
    @classmethod
    def _in_order(cls, changes: list[Change]) -> list[Change]:
        times = [c.at for c in changes]
        if times != sorted(set(times)):
            raise ValueError(f"changes at {times} s are not in order of time; sort them, one at a time")
        return changes


class ReferenceComponent(Part):
    """Reference signals made by steps and ramps."""

    block: Literal["reference"]
    signals: dict[str, Profile] = Field(min_length=1)


class PlaybackComponent(Part):
    """Columns of a CSV file, each value held until the next row."""

    block: Literal["playback"]
    file: str


class Design(Part):
    """Gains designed before the run, from weights (diagonals) and the numbers of the design model."""

    component: Name = "controller"
    Q: list[NotNegative] = Field(default=[1.0, 0.5, 0.1, 0.01, 0.0], min_length=5, max_length=5)
    R: list[Positive] = Field(default=[1.0, 1.0], min_length=2, max_length=2)
    estimator: Literal["appendix_f", "lagged", "consistent"] | None = None
    thrust_nominal: Positive | None = None
    lag: Positive | None = None


class Criterion(Part):
    """A figure of merit and its limit; `to` is a number or another signal, `after` and `until` bound the time [s]."""

    of: Variable
    to: Number | Variable = 0.0
    band: Positive | None = None
    after: Number = 0.0
    until: Number | None = None
    max: Number


KINDS = ("settling_time", "overshoot", "rms_error", "final_error", "peak", "effort")
Criteria = dict[
    Literal["settling_time", "overshoot", "rms_error", "final_error", "peak", "effort"], Criterion | list[Criterion]
]
Component = Annotated[
    Annotated[FmuComponent, Tag("«fmu»")]
    | Annotated[ReferenceComponent, Tag("«reference»")]
    | Annotated[PlaybackComponent, Tag("«playback»")],
    Discriminator(
        _kind_of,
        custom_error_type="component",
        custom_error_message="a component has fmu: FILE, block: reference or block: playback",
    ),
]


class Scenario(Part):
    """One co-simulation."""

    name: str
    description: str = ""
    duration: Positive
    step: Positive
    start_time: Number = 0.0
    seed: Annotated[int, Field(strict=True, ge=0)] = 0
    algorithm: Literal["gauss-seidel", "jacobi"] = "gauss-seidel"
    order: list[Name] | None = None
    noise: bool = True
    design: Design | None = None
    components: dict[Name, Component] = Field(min_length=1)
    connections: list[Connection] = []
    criteria: Criteria = {}

    @property
    def steps(self) -> int:
        """Number of communication steps."""
        return round(self.duration / self.step)

    @property
    def goals(self) -> list[tuple[str, int | None, Criterion]]:
        """Every criterion: kind, its place in a list of several, itself."""
        flat: list[tuple[str, int | None, Criterion]] = []
        for kind, one_or_many in self.criteria.items():
            if isinstance(one_or_many, Criterion):
                flat.append((kind, None, one_or_many))
            else:
                flat += [(kind, k, criterion) for k, criterion in enumerate(one_or_many)]
        return flat


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
        if "scenario" in data and "schema_version" in data:
            self.manifest, data = data, data["scenario"]
            self.yaml.root = self.yaml.root["scenario"]
        for override in overrides:
            _override(path, data, override)
        self.broken: set[str] = set()
        self.connection_lines: list[int] = list(range(len(data.get("connections") or [])))
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
                return scenario
        raise InputError(self.faults)

    def resolve(self, name: str) -> Path:
        """A file named in the scenario, relative to the scenario's own folder."""
        return (self.path.parent / name).resolve()

    def fault(self, location: tuple[str | int, ...], message: str, exit_code: int = 2) -> Fault:
        """A fault at a place of the scenario."""
        return self.yaml.fault(location, message, exit_code=exit_code)

    def _step_faults(self) -> list[Fault]:
        s = self.scenario
        if s.name == PLACEHOLDER:
            return []
        count = s.duration / s.step
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
            if not 0 <= criterion.after < end <= self.scenario.duration:
                faults.append(
                    self.fault(
                        where,
                        f"{kind} looks from {criterion.after:g} s to {end:g} s of {self.scenario.duration:g} s",
                    )
                )
        return faults


PLACEHOLDER = "?"
STAND_INS: dict[str, Any] = {"name": PLACEHOLDER, "duration": 1.0, "step": 0.1}


class Salvage:
    """A scenario's data without its faulty parts, so that the rest can still be checked for meaning."""

    def __init__(self, data: dict[str, Any]) -> None:
        self.data = copy.deepcopy(data)
        self.broken: set[str] = set()
        self.connection_lines = list(range(len(data.get("connections") or [])))

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
        if isinstance(node, list) and key.isdigit() and int(key) < len(node):
            node = node[int(key)]
        elif isinstance(node, dict):
            node = node.setdefault(key, {})
        else:
            raise InputError([Fault(path, 0, 0, f'--set "{text}": there is no {target} in the scenario')])
    if isinstance(node, dict):
        node[keys[-1]] = parsed
    elif isinstance(node, list) and keys[-1].isdigit() and int(keys[-1]) < len(node):
        node[int(keys[-1])] = parsed
    else:
        raise InputError([Fault(path, 0, 0, f'--set "{text}": there is no {target} in the scenario')])


def resolved(scenario: Scenario) -> dict[str, Any]:
    """A scenario as a JSON mapping, defaults spelled out."""
    data: dict[str, Any] = json.loads(scenario.model_dump_json(by_alias=True, exclude_none=True))
    return data
