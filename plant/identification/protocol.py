"""Protocols of a bench: known parameters, cells, and simulated or measured tests."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from cosim.base.errors import Fault, InputError
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
from plant.identification.artefacts import PROTOCOL

LEAST = 3  # repetitions: intervals come from the scatter between them
CHANNELS = {"z": "N", "x": "N", "m": "N.m"}  # cell → SI unit
BENCH = "bench"  # the bench of this package
MAX_OVERLOAD = 1.5  # largest calibration load, as a multiple of full scale
MIN_SPAN = 10.0  # least range of calibration loads, as a multiple of a load's error
WINDOWS = ("rest", "window", "hold")  # windows of a test
LONGEST = 3600.0  # [s] of a simulated run

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
        """Yield name and test of each test done."""
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
    """A protocol; `known` is the bench with the stated parameters, exact for a simulated one."""

    yaml: YamlFile
    file: ProtocolFile
    known: Bench

    @property
    def folder(self) -> Path:
        """Return the folder of the protocol."""
        return self.yaml.path.parent

    @property
    def true_known(self) -> bool:
        """Return True for the simulated bench."""
        return self.file.bench == BENCH


def partly_read(path: Path) -> tuple[Protocol, list[Fault]]:
    """Return a protocol and its faults.

    Raises:
        InputError: The file is not readable.
    """
    check_given(path, PROTOCOL)
    yaml = YamlFile(path)
    content, faults = yaml.partly(ProtocolFile, "tests")
    if content is None:
        raise InputError(faults)
    bench = Bench()
    units = {n: p.unit for n, p in bench.declared.items()}
    parameters, of_units = yaml.in_units(("parameters",), content.parameters, units)
    content = content.model_copy(update={"parameters": parameters})
    faults += [*of_units, *_parameter_faults(yaml, content, bench)]
    faults += _cell_faults(yaml, content)
    faults += [fault for name, test in content.tests.named_tests() for fault in _test_faults(yaml, content, name, test)]
    if not any(True for _ in content.tests.named_tests()):
        faults.append(yaml.fault(("tests",), f"holds no test; known are {', '.join(Tests.model_fields)}", key=True))
    if content.bench not in (None, BENCH) and not (path.parent / str(content.bench)).is_file():
        message = f"no such FMU: {content.bench}; write {BENCH} for the one that is built here, or the path of yours"
        faults.append(yaml.fault(("bench",), message))
    if faults:
        return Protocol(yaml, content, bench), faults
    return Protocol(yaml, content, bench.with_values(content.parameters)), []


def _parameter_faults(yaml: YamlFile, content: ProtocolFile, bench: Bench) -> Iterator[Fault]:
    for name, value in content.parameters.items():
        if name not in bench.declared:
            yield yaml.fault(
                ("parameters", name), f'a bench has no "{name}"{did_you_mean(name, bench.declared)}', key=True
            )
        elif fault := bench.declared[name].fault(value):
            yield yaml.fault(("parameters", name), fault)


def _cell_faults(yaml: YamlFile, content: ProtocolFile) -> Iterator[Fault]:
    for name in CHANNELS.keys() - content.cells.keys():
        yield yaml.fault(("cells",), f'cell "{name}" is missing; a bench has {", ".join(CHANNELS)}', key=True)
    for name, cell in content.cells.items():
        if name not in CHANNELS:
            yield yaml.fault(("cells", name), f"no such cell; a bench has {', '.join(CHANNELS)}", key=True)
            continue
        if factor(cell.unit, CHANNELS[name]) is None:
            message = f"{cell.unit} is no unit of {CHANNELS[name]}{_force_unit(cell.unit)}"
            yield yaml.fault(("cells", name, "unit"), message)
        written = yaml.root["cells"][name]
        if bool(cell.loads) != bool(cell.points):
            yield from _calibration_faults(yaml, content, name, cell)
        elif cell.loads or not (written.get("loads") or written.get("points")):  # unreadable values are reported
            cure = "give `loads` to hang on the bench that is played, or `points` [load, voltage] as measured"
            yield yaml.fault(("cells", name), f"has {'both' if cell.loads else 'no'} loads and points; {cure}")


def _calibration_faults(yaml: YamlFile, content: ProtocolFile, name: str, cell: CellFile) -> Iterator[Fault]:
    """Yield faults of calibration loads or points."""
    at, unit, key = ("cells", name), cell.unit, "loads" if cell.loads else "points"
    if cell.loads and content.bench is None:
        yield yaml.fault((*at, key), "no bench is played; give `points` [load, voltage] as measured")
        return
    if twice := [k for k, load in enumerate(cell.loads) if load in cell.loads[:k]]:
        for k in twice:
            yield yaml.fault((*at, key, k), f"{cell.loads[k]:g} is hung twice; hang each load once")
        return
    loads = np.array(cell.loads or [load for load, _ in cell.points], float)
    beyond = np.flatnonzero(np.abs(loads) > MAX_OVERLOAD * cell.full_scale).tolist()
    span, error = float(np.ptp(loads)), cell.error * cell.full_scale
    if len(loads) < 4:
        yield yaml.fault((*at, key), "a curve needs four points at least; measure more")
    elif beyond:
        message = f"{loads[beyond[0]]:g} {unit} is beyond the cell's full_scale of {cell.full_scale:g} {unit}"
        yield yaml.fault((*at, key, beyond[0]), f"{message}; correct the unit, the load or full_scale")
    elif span < MIN_SPAN * error:
        message = f"the loads span {span:.3g} {unit}, where the error of each is {error:.3g} {unit}"
        cure = "correct the unit, or hang larger loads"
        yield yaml.fault(at, f"{message} (`error` of `full_scale`); {cure}", key=True)


def _force_unit(unit: str) -> str:
    """Return a hint for a mass unit."""
    return f"; a mass that is hung is a force: write {unit}f" if unit in ("g", "kg") else ""


def _test_faults(yaml: YamlFile, content: ProtocolFile, name: str, test: Test) -> Iterator[Fault]:
    at = ("tests", name)
    if test.files:
        yield from _file_faults(yaml, at, test.files)
    elif content.bench is None:
        cure = "name the bench that is to be played as `bench:`, or the recordings as `files:`"
        yield yaml.fault(at, f"has no files, and no bench is played; {cure}", key=True)
    else:
        yield from _phase_faults(yaml, at, test)
    for key in WINDOWS:
        window = getattr(test, key, None)
        if window is not None and window[0] >= window[1]:
            yield yaml.fault((*at, key), f"{window[0]:g} … {window[1]:g} s is empty; write its start, then its end")
    if isinstance(test, SineTest) and len(test.periods) != len(test.frequencies):
        yield yaml.fault((*at, "periods"), f"{len(test.periods)} for {len(test.frequencies)} frequencies; one each")
    if isinstance(test, HeightTest) and not test.files and len(test.heights) < 2:
        yield yaml.fault((*at, "heights"), "two heights at least")


def _file_faults(yaml: YamlFile, at: tuple[str, ...], files: list[str]) -> Iterator[Fault]:
    if len(files) < LEAST:
        few = f"{counted(len(files), 'recording')}, too few"
        yield yaml.fault((*at, "files"), f"{few}: intervals come from scatter between {LEAST} or more")
    for k, file in enumerate(files):
        if file in files[:k]:
            yield yaml.fault((*at, "files", k), f"{file} is named twice; a repetition is a run of its own")


def _phase_faults(yaml: YamlFile, at: tuple[str, ...], test: Test) -> Iterator[Fault]:
    if not test.phases and not isinstance(test, SineTest):
        yield yaml.fault(at, "has neither phases to play nor files; give either", key=True)
    if test.repetitions < LEAST:
        message = f"{test.repetitions} are too few: intervals come from scatter between {LEAST} or more"
        yield yaml.fault((*at, "repetitions"), message)
    times = [p[0] for p in test.phases]
    if times != sorted(times) or (times and times[-1] > LONGEST):
        yield yaml.fault((*at, "phases"), f"times of phases increase, up to {LONGEST:g} s")
    elif times and not isinstance(test, SineTest):
        yield from _missing_phases(yaml, at, test, times[-1])


def _missing_phases(yaml: YamlFile, at: tuple[str, ...], test: Test, end: float) -> Iterator[Fault]:
    for key in WINDOWS:
        window = getattr(test, key, None)
        if window is not None and window[1] > end + 1e-9:
            yield yaml.fault((*at, key), f"ends at {window[1]:g} s, the phases at {end:g} s; move it or add a phase")
    duty = [p[1] for p in test.phases if p[0] <= test.rest[1]]
    if duty and duty[0] > REST_DUTY:
        message = (
            f"begins with duty {duty[0]:g} %: a phase at rest is missing ({REST_DUTY:g} % or less), cells have no tare"
        )
        yield yaml.fault((*at, "phases"), message)
