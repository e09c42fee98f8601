"""Protocols of a bench: known parameters, cells, and simulated or measured tests."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from cosim.base.errors import Fault
from cosim.base.text import counted
from cosim.base.units import factor
from cosim.storage.kinds import check_given
from cosim.storage.yaml_file import (
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
from plant.bench import FREE_HEIGHT, REST_DUTY, Bench
from plant.identification import messages
from plant.identification.artefacts import PROTOCOL

MIN_REPETITIONS = 3  # repetitions: intervals come from the scatter between them
CHANNELS = {"z": "N", "x": "N", "m": "N.m"}  # cell → SI unit
BENCH = "bench"  # the bench of this package
MAX_OVERLOAD = 1.5  # largest calibration load, as a multiple of full scale
MIN_SPAN = 10.0  # least range of calibration loads, as a multiple of a load's error
WINDOWS = ("rest", "window", "hold")  # windows of a test
MAX_RUN_TIME = 3600.0  # [s] of a simulated run

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
    """A protocol.

    Attributes:
        bench: The bench with the stated parameters, exact for a simulated one.
        is_bench_right: False if parameters or cells have faults; recordings cannot be judged by them.
    """

    yaml: YamlFile
    file: ProtocolFile
    bench: Bench
    is_bench_right: bool = True

    @property
    def folder(self) -> Path:
        """Return the folder of the protocol."""
        return self.yaml.path.parent

    @property
    def is_simulated(self) -> bool:
        """Return whether the protocol names the simulated bench."""
        return self.file.bench == BENCH


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
    of_bench = [*of_units, *_parameter_faults(yaml, content, bench), *_cell_faults(yaml, content)]
    faults += of_bench
    faults += [fault for name, test in content.tests.named_tests() for fault in _test_faults(yaml, content, name, test)]
    if not any(True for _ in content.tests.named_tests()):
        faults.append(yaml.fault(("tests",), messages.NO_TEST(names=", ".join(Tests.model_fields)), key=True))
    if content.bench not in (None, BENCH) and not (path.parent / str(content.bench)).is_file():
        faults.append(yaml.fault(("bench",), messages.NO_FMU(name=content.bench, bench=BENCH)))
    if of_bench:
        return Protocol(yaml, content, bench, is_bench_right=False), faults
    return Protocol(yaml, content, bench.with_values(content.parameters)), faults


def _parameter_faults(yaml: YamlFile, content: ProtocolFile, bench: Bench) -> Iterator[Fault]:
    for name, value in content.parameters.items():
        if name not in bench.declared:
            message = messages.UNKNOWN_PARAMETER(name=name, hint=did_you_mean(name, bench.declared))
            yield yaml.fault(("parameters", name), message, key=True)
        elif reason := bench.declared[name].fault(value):
            yield yaml.fault(("parameters", name), reason)


def _cell_faults(yaml: YamlFile, content: ProtocolFile) -> Iterator[Fault]:
    names = ", ".join(CHANNELS)
    for name in CHANNELS.keys() - content.cells.keys():
        yield yaml.fault(("cells",), messages.NO_CELL(name=name, names=names), key=True)
    for name, cell in content.cells.items():
        if name not in CHANNELS:
            yield yaml.fault(("cells", name), messages.UNKNOWN_CELL(names=names), key=True)
            continue
        if factor(cell.unit, CHANNELS[name]) is None:
            mass = cell.unit in ("g", "kg")
            hint = f"; a mass that is hung is a force: write {cell.unit}f" if mass else ""
            message = messages.WRONG_UNIT(unit=cell.unit, wanted=CHANNELS[name], hint=hint)
            yield yaml.fault(("cells", name, "unit"), message)
        source = yaml.root["cells"][name]
        if bool(cell.loads) != bool(cell.points):
            yield from _calibration_faults(yaml, content, name, cell)
        elif cell.loads or not (source.get("loads") or source.get("points")):  # unreadable values are reported
            yield yaml.fault(("cells", name), (messages.LOADS_AND_POINTS if cell.loads else messages.NO_LOADS)())


def _calibration_faults(yaml: YamlFile, content: ProtocolFile, name: str, cell: CellFile) -> Iterator[Fault]:
    """Yield faults in a cell's loads or points."""
    at, unit, key = ("cells", name), cell.unit, "loads" if cell.loads else "points"
    if cell.loads and content.bench is None:
        yield yaml.fault((*at, key), messages.LOADS_WITHOUT_BENCH())
        return
    if places := [k for k, load in enumerate(cell.loads) if load in cell.loads[:k]]:
        for k in places:
            yield yaml.fault((*at, key, k), messages.REPEATED_LOAD(load=cell.loads[k]))
        return
    loads = np.array(cell.loads or [load for load, _ in cell.points], float)
    beyond = np.flatnonzero(np.abs(loads) > MAX_OVERLOAD * cell.full_scale).tolist()
    span, error = float(np.ptp(loads)), cell.error * cell.full_scale
    if len(loads) < 4:
        yield yaml.fault((*at, key), messages.TOO_FEW_LOADS())
    elif beyond:
        message = messages.LOAD_BEYOND_SCALE(load=loads[beyond[0]], unit=unit, limit=cell.full_scale)
        yield yaml.fault((*at, key, beyond[0]), message)
    elif span < MIN_SPAN * error:
        yield yaml.fault(at, messages.NARROW_LOADS(span=span, unit=unit, error=error), key=True)


def _test_faults(yaml: YamlFile, content: ProtocolFile, name: str, test: Test) -> Iterator[Fault]:
    at = ("tests", name)
    windows = {key: window for key in WINDOWS if (window := getattr(test, key, None)) is not None}
    if test.files:
        yield from _file_faults(yaml, at, test.files)
    elif content.bench is None:
        yield yaml.fault(at, messages.NO_FILES(), key=True)
    else:
        yield from _phase_faults(yaml, at, test, windows)
    for key, (start, end) in windows.items():
        if start >= end:
            yield yaml.fault((*at, key), messages.EMPTY_WINDOW(start=start, end=end))
    if isinstance(test, SineTest) and len(test.periods) != len(test.frequencies):
        counts = {"periods": len(test.periods), "frequencies": len(test.frequencies)}
        yield yaml.fault((*at, "periods"), messages.PERIODS_UNLIKE_FREQUENCIES(**counts))
    if isinstance(test, HeightTest) and not test.files and len(test.heights) < 2:
        yield yaml.fault((*at, "heights"), messages.TOO_FEW_HEIGHTS())


def _file_faults(yaml: YamlFile, at: tuple[str, ...], files: list[str]) -> Iterator[Fault]:
    if len(files) < MIN_REPETITIONS:
        message = messages.TOO_FEW_FILES(recordings=counted(len(files), "recording"), least=MIN_REPETITIONS)
        yield yaml.fault((*at, "files"), message)
    for k, file in enumerate(files):
        if file in files[:k]:
            yield yaml.fault((*at, "files", k), messages.REPEATED_FILE(name=file))


def _phase_faults(yaml: YamlFile, at: tuple[str, ...], test: Test, windows: Mapping[str, Window]) -> Iterator[Fault]:
    if not test.phases and not isinstance(test, SineTest):
        yield yaml.fault(at, messages.NO_PHASES(), key=True)
    if test.repetitions < MIN_REPETITIONS:
        message = messages.TOO_FEW_REPETITIONS(count=test.repetitions, least=MIN_REPETITIONS)
        yield yaml.fault((*at, "repetitions"), message)
    times = [p[0] for p in test.phases]
    if times != sorted(times) or (times and times[-1] > MAX_RUN_TIME):
        yield yaml.fault((*at, "phases"), messages.WRONG_TIMES_OF_PHASES(limit=MAX_RUN_TIME))
    elif times and not isinstance(test, SineTest):
        for key, (_, end) in windows.items():
            if end > times[-1] + 1e-9:
                yield yaml.fault((*at, key), messages.WINDOW_AFTER_PHASES(end=end, last=times[-1]))
        if times[0] <= test.rest[1] and (duty := test.phases[0][1]) > REST_DUTY:
            yield yaml.fault((*at, "phases"), messages.THRUST_AT_START(duty=duty, limit=REST_DUTY))
