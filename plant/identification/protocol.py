"""Protocols of a bench: known parameters, cells, and simulated or measured tests."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from cosim.core.errors import Fault
from cosim.core.units import factor
from cosim.files.kinds import check_given
from cosim.files.yaml_file import (
    UNIT_OF_KEY,
    Amount,
    InUnit,
    NotNegative,
    NotNegativeSeconds,
    Number,
    Part,
    Positive,
    PositiveAmount,
    PositiveSeconds,
    Share,
    YamlFile,
    did_you_mean,
)
from plant.bench import FREE_HEIGHT, Bench
from plant.identification import PROTOCOL

MIN_REPETITIONS = 3  # repetitions: intervals come from the scatter between them
CHANNELS = {"z": "N", "x": "N", "m": "N.m"}  # cell → SI unit
BENCH = "bench"  # the bench of this package
MAX_OVERLOAD = 1.5  # largest calibration load, as a multiple of full scale
MAX_RUN_TIME = 3600.0  # [s] of a simulated run
MIN_HEIGHT = 0.5  # [radii] least height in eq 4.28

Metres = Annotated[Positive, InUnit("m")]
Volts = Annotated[NotNegative, InUnit("V", difference=True)]
Percent = InUnit("%")
Window = tuple[NotNegativeSeconds, NotNegativeSeconds]
# time [s], duty [%], tilt [deg]
Phase = tuple[NotNegativeSeconds, Annotated[NotNegative, Percent], Annotated[Number, InUnit("deg")]]


class CellFile(Part):
    """A load cell: calibration loads, or measured points.

    unit:       Unit of full scale and loads.
    full_scale: Largest load.
    error:      Standard deviation as a share of full scale.
    loads:      Simulated calibration loads.
    points:     Measured load and voltage [V] of each point, instead of loads.
    """

    unit: str = "N"
    full_scale: PositiveAmount
    error: Annotated[NotNegative, Share, Field(le=0.1)] = 0.0025
    loads: list[Amount] = Field(default=[])
    points: list[tuple[Amount, Annotated[Number, InUnit("V")]]] = Field(default=[])  # load, voltage

    @field_validator("full_scale", "loads", "points", mode="before")
    @classmethod
    def _in_its_unit(cls, value: Any, info: ValidationInfo) -> Any:
        """Return loads in the unit of the cell."""
        unit = InUnit(str(info.data.get("unit", "")))
        if info.field_name == "points" and isinstance(value, list):
            return [[unit.number(p[0]), *p[1:]] if isinstance(p, list) and p else p for p in value]
        return [unit.number(v) for v in value] if isinstance(value, list) else unit.number(value)


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

    repetitions: Annotated[int, Field(strict=True, ge=1, le=10_000, description="runs that are played")] = 1
    files: list[str] = Field(default=[], description="runs that were measured, a CSV each, in place of phases")
    low_pass: NotNegativeSeconds = Field(
        default=0.0, description="time constant of the filter of readings [s]; 0: none"
    )
    height: Metres = Field(default=FREE_HEIGHT, description="of the propeller above the ground [m]")
    phases: list[Phase] = Field(default=[], description="time [s], duty [%], tilt [deg] each, straight in between")
    rest: Window = Field(description="from and to [s], without thrust: the tare")
    window: Window = Field(description="from and to [s], what is looked at")


class HeightTest(Test):
    """Thrust at several heights relative to the thrust far from the ground.

    heights:         Heights in propeller radii.
    free_height:     Height without ground effect [m].
    validation_duty: Duty of the validation set [%].
    """

    heights: list[Positive] = Field(default=[])
    free_height: Metres = FREE_HEIGHT
    validation_duty: Annotated[Positive, Percent] | None = None


class HoldTest(Test):
    """Forces over the tilt.

    hold: Start and end [s], upright, under full thrust.
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
    periods:     Periods of each, whole or fractional.
    amplitude:   Amplitude [deg].
    duty:        Duty [%].
    lead:        Time before the sines [s].
    skip:        First part of the sines to ignore [s].
    thesis_skip: Periods of each ignored in the thesis.
    """

    frequencies: list[Annotated[Positive, InUnit("rad/s")]]
    periods: list[Positive]
    amplitude: Annotated[Positive, InUnit("deg")] = 10.0
    duty: Annotated[Positive, Percent]
    lead: PositiveSeconds = 3.0
    skip: PositiveSeconds = 1.0
    thesis_skip: list[NotNegative] = Field(default=[])  # periods


class Tests(Part):
    """Tests; only the listed ones are done.

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
    bench:      `bench`, built here, or the FMU of another bench; by default tests need files.
    model:      Model whose parameters powertrain.yaml sets.
    seed:       Seed of every random stream.
    step:       Time between rows [s].
    parameters: Parameters of the bench that differ from its defaults.
    draws:      Variation between runs.
    cells:      z, x, m: cells of the forces and the moment.
    tests:      Tests to do.
    """

    schema_version: Literal[1] = 1
    name: str
    bench: str | None = None
    model: str = "hovercraft"
    seed: Annotated[int, Field(strict=True, ge=0)] = 1
    step: PositiveSeconds = 0.02
    parameters: dict[str, Annotated[Number, UNIT_OF_KEY]] = Field(default={})
    draws: Draws = Draws()
    cells: dict[str, CellFile]
    tests: Tests


@dataclass(frozen=True)
class Protocol:
    """A protocol, and the bench with its parameters, exact for a simulated one."""

    yaml: YamlFile
    file: ProtocolFile
    bench: Bench

    @property
    def folder(self) -> Path:
        """Return the folder of the protocol."""
        return self.yaml.path.parent

    def load_in_si(self, channel: str) -> float:
        """Return the load unit of a cell in N or N m; a gram-force is converted with the bench's gravity."""
        unit = self.file.cells[channel].unit
        gravity = self.bench.gravity / 9.80665 if unit == "gf" else 1.0
        return (factor(unit, CHANNELS[channel]) or 1.0) * gravity


def read_partly(path: Path) -> tuple[Protocol, list[Fault]]:
    """Return a protocol and its faults.

    Raises:
        InputError: The file is not readable.
    """
    check_given(path, PROTOCOL)
    yaml = YamlFile(path)
    content, faults = yaml.partly(ProtocolFile, "tests")
    bench = Bench()
    units = {n: p.unit for n, p in bench.declared.items()}
    parameters, of_units = yaml.in_units(("parameters",), content.parameters, units)
    content = content.model_copy(update={"parameters": parameters})
    faults += of_units
    for name, value in parameters.items():
        if name not in bench.declared:
            message = f'a bench has no "{name}"{did_you_mean(name, bench.declared)}'
            faults.append(yaml.fault(("parameters", name), message, key=True))
        elif reason := bench.declared[name].fault(value):
            faults.append(yaml.fault(("parameters", name), reason))
    faults += _cell_faults(yaml, content)
    if not list(content.tests.named_tests()):
        message = f"holds no test; add one of {', '.join(Tests.model_fields)}"
        faults.append(yaml.fault(("tests",), message, key=True))
    if content.bench not in (None, BENCH) and not (path.parent / str(content.bench)).is_file():
        cure = f"write {BENCH} for the one that is built here, or the path of yours"
        faults.append(yaml.fault(("bench",), f"no such FMU: {content.bench}; {cure}"))
    if not faults:
        bench = bench.with_values(parameters)
    for name, test in content.tests.named_tests():
        faults += _test_faults(yaml, content, bench, ("tests", name), test)
    return Protocol(yaml, content, bench), faults


def _cell_faults(yaml: YamlFile, content: ProtocolFile) -> Iterator[Fault]:
    names = ", ".join(CHANNELS)
    for name in CHANNELS.keys() - content.cells.keys():
        yield yaml.fault(("cells",), f'cell "{name}" is missing; a bench has {names}', key=True)
    for name, cell in content.cells.items():
        at = ("cells", name)
        if name not in CHANNELS:
            yield yaml.fault(at, f"no such cell; a bench has {names}", key=True)
            continue
        if factor(cell.unit, CHANNELS[name]) is None:
            is_mass = cell.unit in ("g", "kg")
            hint = f"; a mass that is hung is a force: write {cell.unit}f" if is_mass else ""
            yield yaml.fault((*at, "unit"), f"{cell.unit} is no unit of {CHANNELS[name]}{hint}")
        source = yaml.root["cells"][name]
        if bool(cell.loads) == bool(cell.points):
            if cell.loads or not (source.get("loads") or source.get("points")):  # unreadable values are reported
                cure = (
                    "give either `loads` to hang on the bench that is played, or `points` [load, voltage] as measured"
                )
                yield yaml.fault(at, f"has {'both' if cell.loads else 'neither'} loads and points; {cure}")
            continue
        loads = np.array(cell.loads or [load for load, _ in cell.points], float)
        beyond = np.flatnonzero(np.abs(loads) > MAX_OVERLOAD * cell.full_scale).tolist()
        key = "loads" if cell.loads else "points"
        if cell.loads and content.bench is None:
            yield yaml.fault((*at, key), "no bench is played; give `points` [load, voltage] as measured")
        elif len(set(loads.tolist())) < 4:
            yield yaml.fault((*at, key), "a curve needs four different loads at least; give more")
        elif beyond:
            text = f"{loads[beyond[0]]:g} is beyond the cell's full_scale of {cell.full_scale:g} {cell.unit}"
            yield yaml.fault((*at, key, beyond[0]), f"{text}; correct the unit, the load or full_scale")


def _test_faults(
    yaml: YamlFile, content: ProtocolFile, bench: Bench, at: tuple[str, ...], test: Test
) -> Iterator[Fault]:
    least = f"too few: intervals come from scatter between {MIN_REPETITIONS} or more"
    if test.files:
        if (count := len(test.files)) < MIN_REPETITIONS:
            yield yaml.fault((*at, "files"), f"{count} recordings are {least}; add recordings")
        for k, file in enumerate(test.files):
            if file in test.files[:k]:
                yield yaml.fault((*at, "files", k), f"{file} is named twice; a repetition is a run of its own")
    elif content.bench is None:
        cure = "name the bench that is to be played as `bench:`, or the recordings as `files:`"
        yield yaml.fault(at, f"has no files, and no bench is played; {cure}", key=True)
    else:
        if test.repetitions < MIN_REPETITIONS:
            yield yaml.fault((*at, "repetitions"), f"{test.repetitions} are {least}; raise the number")
        times = [p[0] for p in test.phases]
        if not times and not isinstance(test, SineTest):
            yield yaml.fault(at, "has neither phases to play nor files; give either", key=True)
        elif times != sorted(times) or (times and times[-1] > MAX_RUN_TIME):
            text = f"times of phases must increase, up to {MAX_RUN_TIME:g} s; correct them"
            yield yaml.fault((*at, "phases"), text)
    for key in ("rest", "window", "hold"):
        start, end = getattr(test, key, (0.0, 1.0))
        if start >= end:
            yield yaml.fault((*at, key), f"{start:g} … {end:g} s is empty; write its start, then its end")
    if isinstance(test, SineTest) and len(test.periods) != len(test.frequencies):
        text = f"{len(test.periods)} for {len(test.frequencies)} frequencies; give one each"
        yield yaml.fault((*at, "periods"), text)
    if isinstance(test, HeightTest) and not test.files:
        heights, highest = test.heights, max(test.heights, default=0.0) * bench.propeller_radius
        for k, height in enumerate(heights):
            if height in heights[:k] or height < MIN_HEIGHT:
                text = f"{height:g} radii are listed twice, or below {MIN_HEIGHT:g}, where eq 4.28 is not valid"
                yield yaml.fault((*at, "heights", k), f"{text}; give another height")
        if len(heights) == 1 or not yaml.root["tests"]["ground_effect"].get("heights"):
            yield yaml.fault((*at, "heights"), "two heights are needed at least; add one")
        elif test.free_height <= highest:
            text = f"{test.free_height:g} m is not above the heights near the ground, which reach {highest:.3g} m"
            cure = "give 10 radii or more, where the ground has no effect"
            yield yaml.fault((*at, "free_height"), f"{text}; {cure}")
