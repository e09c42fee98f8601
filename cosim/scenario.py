"""Scenario files: what is run, how it is connected, what it must achieve."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from cosim.errors import Fault, InputError
from cosim.yaml_file import YamlFile, plain

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
Variable = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*\.\S+$")]
ROUNDING = 1e-9  # relative slack when a duration is divided into steps


class Part(BaseModel):
    """A part of a scenario: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)


class Noise(Part):
    """Gaussian noise and bias that a connection adds, in the square of the signal's unit and in its unit."""

    variance: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)] = 0.0
    bias: Number = 0.0


class Connection(Part):
    """From one output to one input, `component.variable`."""

    source: Variable = Field(alias="from")
    target: Variable = Field(alias="to")
    noise: Noise | None = None


class FmuComponent(Part):
    """An FMU and the start values it is given, a number in the variable's unit or text such as `12 deg`."""

    fmu: str
    start: dict[str, bool | Number | str] = {}
    sha256: str | None = None


class Change(Part):
    """A reference goes `to` a value `at` a time [s]: a step, or a ramp at `rate` a second."""

    at: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)]
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
    Q: list[Number] = Field(default=[1.0, 0.5, 0.1, 0.01, 0.0], min_length=5, max_length=5)
    R: list[Number] = Field(default=[1.0, 1.0], min_length=2, max_length=2)
    estimator: Literal["appendix_f", "lagged", "consistent"] | None = None
    thrust_nominal: Positive | None = None
    lag: Positive | None = None

    @model_validator(mode="after")
    def _weights(self) -> Self:
        if min(self.Q) < 0 or min(self.R) <= 0:
            raise ValueError("Q has no negative entry and R only positive ones")
        return self


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
Component = FmuComponent | ReferenceComponent | PlaybackComponent


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
    """A scenario and the file it came from, so that later checks can name the place."""

    def __init__(self, path: Path, overrides: Sequence[str] = ()) -> None:
        self.path = path
        self.yaml = YamlFile(path)
        self.prefix: tuple[str, ...] = (
            ("scenario",) if "scenario" in self.yaml.root and "schema_version" in self.yaml.root else ()
        )
        data = plain(self.yaml.root)
        self.manifest: Mapping[str, Any] | None = data if self.prefix else None
        if self.prefix:
            self.yaml.root = self.yaml.root["scenario"]
            data = data["scenario"]
        for override in overrides:
            _override(path, data, override)
        self.scenario = self.yaml.validate(Scenario, data)
        if faults := [*self._step_faults(), *self._criteria_faults()]:
            raise InputError(faults)

    def resolve(self, name: str) -> Path:
        """A file named in the scenario, relative to the scenario's own folder."""
        return (self.path.parent / name).resolve()

    def fault(self, location: tuple[str | int, ...], message: str, exit_code: int = 2) -> Fault:
        """A fault at a place of the scenario."""
        return self.yaml.fault(location, message, exit_code=exit_code)

    def _step_faults(self) -> list[Fault]:
        s = self.scenario
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
                        f"{kind} looks from {criterion.after:g} s to {end:g} s; the run lasts {self.scenario.duration:g} s",
                    )
                )
        return faults


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
    """A scenario as a JSON mapping, defaults left out."""
    data: dict[str, Any] = json.loads(scenario.model_dump_json(by_alias=True, exclude_defaults=True))
    return data
