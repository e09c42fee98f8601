"""Protocols of a bench: known parameters, cells, and simulated or measured tests."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from cosim.core.errors import refuse
from cosim.core.text import did_you_mean
from cosim.core.units import factor
from cosim.files.kinds import check_given
from cosim.files.yaml_file import (
    UNIT_OF_KEY,
    InUnit,
    NotNegative,
    NotNegativeSeconds,
    Number,
    Part,
    Positive,
    PositiveSeconds,
    Share,
    YamlFile,
)
from plant.bench import FREE_HEIGHT, Bench
from plant.identification import PROTOCOL

MIN_REPETITIONS = 3  # repetitions: intervals are computed from the scatter between them
CELL_UNITS = {"z": "N", "x": "N", "m": "N.m"}  # cell → SI unit
MIN_STEP, MAX_RUN_TIME = 1e-3, 3600.0  # [s] between rows of a simulated run, and of the whole


def _forward(times: tuple[float, float]) -> tuple[float, float]:
    if times[0] >= times[1]:
        raise ValueError(f"{times[0]:g} … {times[1]:g} s is empty; give the start before the end")
    return times


def _distinct(values: list[Any]) -> list[Any]:
    if len(set(values)) < len(values):
        raise ValueError("an entry occurs twice; give each height once, and a separate run per repetition")
    return values


Phase = tuple[NotNegativeSeconds, Annotated[NotNegative, InUnit("%")], Annotated[Number, InUnit("deg")]]


def _in_order(phases: list[Phase]) -> list[Phase]:
    times = [time for time, *_ in phases]
    if times != sorted(times) or max(times, default=0.0) > MAX_RUN_TIME:
        raise ValueError(f"times of phases must increase, up to {MAX_RUN_TIME:g} s; correct them")
    return phases


Files = Annotated[list[str], AfterValidator(_distinct)]
Metres = Annotated[Positive, InUnit("m")]
Volts = Annotated[NotNegative, InUnit("V", difference=True)]
Percent = Annotated[Positive, InUnit("%")]
Window = Annotated[tuple[NotNegativeSeconds, NotNegativeSeconds], AfterValidator(_forward)]


class CellFile(Part):
    """A load cell: calibration loads, or measured points.

    unit:       Unit of full scale and loads.
    full_scale: Largest load.
    error:      Standard deviation of each load, as a share of full scale.
    loads:      Simulated calibration loads.
    points:     Measured load and voltage [V] of each point, instead of loads.
    """

    unit: str = "N"
    full_scale: Positive
    error: Annotated[NotNegative, Share, Field(le=0.1)] = 0.0025
    loads: list[Number] = Field(default=[])
    points: list[tuple[Number, Annotated[Number, InUnit("V")]]] = Field(default=[])  # load, voltage

    @model_validator(mode="after")
    def _has_a_curve(self) -> Self:
        """Raise ValueError for a cell without a calibration, or with two."""
        if bool(self.loads) == bool(self.points):
            raise ValueError("give either `loads` for the simulated bench, or measured `points`")
        return self


class Draws(Part):
    """Variation between runs of a simulated bench, as standard deviations.

    thrust: Relative thrust change by the battery.
    tare:   Tare of each cell [V].
    noise:  Noise of each cell's readings [V].
    """

    thrust: Annotated[NotNegative, Share] = 0.0
    tare: dict[str, Volts] = Field(default={})
    noise: dict[str, Volts] = Field(default={})


class Test(Part):
    """A test: simulated `phases`, or measured `files`."""

    repetitions: Annotated[int, Field(strict=True, ge=MIN_REPETITIONS, le=10_000, description="simulated runs")] = (
        MIN_REPETITIONS
    )
    files: Files = Field(
        default=[], min_length=MIN_REPETITIONS, description="measured runs, one CSV file each, instead of phases"
    )
    low_pass: NotNegativeSeconds = Field(
        default=0.0, description="time constant of the filter of readings [s]; 0: none"
    )
    height: Metres = Field(default=FREE_HEIGHT, description="of the propeller above the ground [m]")
    phases: Annotated[list[Phase], AfterValidator(_in_order)] = Field(
        default=[], description="time [s], duty [%] and tilt [deg] of each point, linear in between"
    )
    rest: Window = Field(description="start and end [s], without thrust, for the tare")
    window: Window = Field(description="start and end [s] of the analysed part")

    @property
    def analysed(self) -> tuple[float, float]:
        """Return the first and last time [s] of the analysed rows."""
        return self.window

    @model_validator(mode="after")
    def _can_be_played(self) -> Self:
        """Raise ValueError for a test without runs."""
        if not (self.files or self.phases or isinstance(self, SineTest)):
            raise ValueError("has neither phases nor files; give one of them")
        return self


class HeightTest(Test):
    """Thrust at several heights relative to the thrust far from the ground.

    heights:         Heights in propeller radii, at least half a radius, below which eq 4.28 is not valid.
    free_height:     Height without ground effect [m].
    validation_duty: Duty of the validation set [%].
    """

    heights: Annotated[list[Annotated[Positive, Field(ge=0.5)]], AfterValidator(_distinct)] = Field(
        default=[], min_length=2
    )
    free_height: Metres = FREE_HEIGHT
    validation_duty: Percent | None = None


class HoldTest(Test):
    """Forces over the tilt.

    hold: Start and end [s] of a time in which the propeller is upright, with full thrust.
    """

    hold: Window


class StepTest(Test):
    """A step response.

    at: Time of the step [s].
    """

    at: PositiveSeconds


class SineTest(Test):
    """Sinusoidal tilt.

    frequencies: Frequencies [rad/s].
    periods:     Number of periods of each frequency, whole or fractional.
    amplitude:   Amplitude [deg].
    duty:        Duty [%].
    lead:        Time before the sines [s].
    skip:        Time at the start of the sines that is ignored [s].
    thesis_skip: Number of periods of each frequency that the thesis ignores.
    """

    frequencies: list[Annotated[Positive, InUnit("rad/s")]]
    periods: list[Positive]
    amplitude: Annotated[Positive, InUnit("deg")] = 10.0
    duty: Percent
    lead: PositiveSeconds = 3.0
    skip: PositiveSeconds = 1.0
    thesis_skip: list[NotNegative] = Field(default=[])  # periods

    @property
    def analysed(self) -> tuple[float, float]:
        """Return the times [s] of the analysed rows."""
        return self.lead + self.skip, float("inf")

    def skipped_by_thesis(self, frequency: float) -> float:
        """Return the time [s] at the start of a sine that the thesis ignores."""
        periods = dict(zip(self.frequencies, self.thesis_skip, strict=False)).get(frequency, 0.0)
        return periods * 2.0 * math.pi / frequency

    @field_validator("periods")
    @classmethod
    def _one_each(cls, periods: list[float], info: ValidationInfo) -> list[float]:
        """Raise ValueError if the numbers of periods and frequencies differ, or a run is too long."""
        frequencies = info.data.get("frequencies", periods)
        if len(periods) != len(frequencies):
            raise ValueError("give one number for each frequency")
        if max((2.0 * math.pi * n / w for n, w in zip(periods, frequencies, strict=True)), default=0.0) > MAX_RUN_TIME:
            raise ValueError(f"a run may last at most {MAX_RUN_TIME:g} s; give fewer periods")
        return periods


class Tests(Part):
    """Tests of a protocol. Only tests that are listed are executed.

    thrust_line:   Thrust over duty.
    ground_effect: Thrust over height.
    projection:    Forces over tilt.
    step:          Lag after a step of the tilt.
    thrust_step:   Lag after a step of the duty.
    frequency:     Lag from sines of the tilt.
    moment:        Moment of the weight over the tilt, motor off.
    """

    thrust_line: Test | None = None
    ground_effect: HeightTest | None = None
    projection: HoldTest | None = None
    step: StepTest | None = None
    thrust_step: StepTest | None = None
    frequency: SineTest | None = None
    moment: Test | None = None

    def named_tests(self) -> Iterator[tuple[str, Test]]:
        """Yield (name, test) for each test in the protocol."""
        for name in type(self).model_fields:
            if (test := getattr(self, name)) is not None:
                yield name, test


class ProtocolFile(Part):
    """A protocol of a testing bench: its cells, and simulated or measured tests.

    schema_version: 1
    name:       Name of the results.
    bench:      `bench`: tests without a file are simulated. Without this key, every test needs a file.
    model:      Model for which powertrain.yaml, the file of results, has parameters.
    seed:       Seed of every random stream.
    step:       Time between rows [s].
    parameters: Parameters of the bench that differ from its defaults.
    draws:      Variation between runs.
    cells:      Load cells of the vertical force (z), the horizontal force (x) and the moment (m).
    tests:      Tests to execute.
    """

    schema_version: Literal[1] = 1
    name: str
    bench: Literal["bench"] | None = None
    model: str = "hovercraft"
    seed: Annotated[int, Field(strict=True, ge=0)] = 1
    step: Annotated[Positive, Field(ge=MIN_STEP), InUnit("s")] = 0.02
    parameters: dict[str, Annotated[Number, UNIT_OF_KEY]] = Field(default={})
    draws: Draws = Draws()
    cells: dict[str, CellFile]
    tests: Tests


@dataclass(frozen=True)
class Protocol:
    """A protocol, and the bench with its parameters; those of a simulated bench are the true values."""

    yaml: YamlFile
    file: ProtocolFile
    bench: Bench

    def load_in_si(self, channel: str) -> float:
        """Return the load unit of a cell in N or N m; a gram-force is converted with the bench's gravity."""
        unit = self.file.cells[channel].unit
        gravity = self.bench.gravity / 9.80665 if unit == "gf" else 1.0
        return (factor(unit, CELL_UNITS[channel]) or 1.0) * gravity


def read_protocol(path: Path) -> Protocol:
    """Read a protocol.

    Raises:
        InputError: The file has faults, all of which the error names.
    """
    check_given(path, PROTOCOL)
    yaml, bench = YamlFile(path), Bench()
    content = yaml.validate(ProtocolFile)
    declared = bench.declared
    content, faults = yaml.in_units(content, "parameters", {n: p.unit for n, p in declared.items()})
    values = content.parameters
    for name, value in values.items():
        if name not in declared:
            text = f'a bench has no "{name}"{did_you_mean(name, declared)}'
            faults.append(yaml.fault(("parameters", name), text, key=True))
        elif reason := declared[name].fault(value):
            faults.append(yaml.fault(("parameters", name), reason))
    if content.cells.keys() != CELL_UNITS.keys():
        faults.append(yaml.fault(("cells",), f"the cells must be {', '.join(CELL_UNITS)}", key=True))
    for name, cell in content.cells.items():
        if name in CELL_UNITS and factor(cell.unit, CELL_UNITS[name]) is None:
            hint = f"; the load of a mass is a force: write {cell.unit}f" if cell.unit in ("g", "kg") else ""
            faults.append(yaml.fault(("cells", name, "unit"), f"{cell.unit} is not a unit of {CELL_UNITS[name]}{hint}"))
        if cell.loads and content.bench is None:
            text = "no bench is simulated; give measured `points` [load, voltage]"
            faults.append(yaml.fault(("cells", name, "loads"), text))
    if not (tests := dict(content.tests.named_tests())):
        faults.append(yaml.fault(("tests",), f"has no test; add one of {', '.join(Tests.model_fields)}", key=True))
    for name, test in tests.items():
        if content.bench is None and not test.files:
            cure = "give a bench to simulate as `bench:`, or recordings as `files:`"
            faults.append(yaml.fault(("tests", name), f"has no files, and no bench is simulated; {cure}", key=True))
    refuse(faults)
    return Protocol(yaml, content, bench.with_values(values))
