"""Columns of a recording: unit, plausible range and meaning, and their check.

Ranges are wide: they detect wrong units or columns, not poor readings.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cosim.base.arrays import Array, Flags
from cosim.base.text import counted
from plant.bench import Bench
from plant.identification.protocol import HeightTest, Test
from plant.powertrain import servo_angle

MAX_HEIGHT = 20.0  # [m]: twice the default height without ground effect, App. D.2; a height in mm or cm exceeds it
MAX_TILT = np.radians(120.0)  # a servo turns by ±90° and some degrees; a duty in other units gives whole turns
MIN_HEIGHT_RATIO = 0.5  # least ratio of height to propeller radius in eq 4.28
MAX_LOWEST_HEIGHT_RATIO = 3.0  # largest ratio for the lowest height of Test 2; above, Γ − 1 is below 1 %
MAX_HEIGHT_CHANGE = 0.1  # share of the height in a window; a bench is fixed
PULSE = "such as 7.5 for a pulse of 1500 µs in a frame of 20 ms"


@dataclass(frozen=True)
class BenchColumn:
    """A column of a recording; `high` None stands for the bench's `converter_range`.

    Attributes:
        cure: Advice for a value outside the range.
    """

    unit: str
    low: float
    high: float | None
    meaning: str
    cure: str


HEIGHT_CURE = f"say its unit, {{name}} [mm]; {MAX_HEIGHT:g} m is as good as no ground"
NEGATIVE_CURE = "write raw voltages: the tare is read at rest and taken off here"
SPIKE_CURE = "a spike; repeat the run, or replace the reading by the mean of its neighbours"
SPIKE_SHARE = 0.02  # share of readings above which the cause is a unit or a saturated cell
VOLTAGE_CURE = "say its unit in the column's name, {name} [mV], or `converter_range` under `parameters`"
COLUMNS = {
    "duty": BenchColumn("%", 0.0, 100.0, "duty of the speed controller", f"write it in % of the frame, {PULSE}"),
    "servo_duty": BenchColumn("%", 0.0, 100.0, "duty of the servo", f"write it in % of the frame, {PULSE}"),
    "height": BenchColumn("m", 0.0, MAX_HEIGHT, "height of the propeller over the ground", HEIGHT_CURE),
    "volts_z": BenchColumn("V", 0.0, None, "vertical cell", VOLTAGE_CURE),
    "volts_x": BenchColumn("V", 0.0, None, "horizontal cell", VOLTAGE_CURE),
    "volts_m": BenchColumn("V", 0.0, None, "cell of the moment about the tilting axis", VOLTAGE_CURE),
}


@dataclass(frozen=True)
class OutOfRange:
    """An implausible value with its row and cure."""

    row: int
    message: str


def out_of_range(known: Bench, values: dict[str, Array]) -> Iterator[OutOfRange]:
    """Yield the first implausible value of each column, and an impossible servo duty."""
    step = known.converter_range / known.converter_levels
    duty_found = False
    for name, column in COLUMNS.items():
        slack, high = (step, known.converter_range) if column.high is None else (0.0, column.high)
        low = column.low - slack
        outside = (values[name] < low) | (values[name] > high + slack)
        if name == "height":
            outside |= values[name] <= 0.0
        if not outside.any():
            continue
        duty_found |= name == "servo_duty"
        row = _first(outside)
        value = f"{name} is {values[name][row]:.4g} {column.unit} here"
        allowed = f"beyond {column.low:g} to {high:g} {column.unit} ({column.meaning})"
        cure = column.cure.format(name=name)
        if column.high is None:
            allowed = f"beyond the converter's 0 to {high:g} V"
            if outside.mean() < SPIKE_SHARE:
                allowed += f", at {counted(int(outside.sum()), 'reading')}"
                cure = SPIKE_CURE
            elif values[name][row] < low:
                cure = NEGATIVE_CURE
        yield OutOfRange(row, f"{value}, {allowed}; {cure}")
    angle = servo_angle(values["servo_duty"], known.servo_neutral, known.servo_slope)
    if not duty_found and (outside := np.abs(angle) > MAX_TILT).any():
        row = _first(outside)
        what = f"servo_duty of {values['servo_duty'][row]:.4g} % is a tilt of {np.degrees(angle[row]):.0f}°"
        allowed = f"beyond ±{np.degrees(MAX_TILT):.0f}°"
        cure = f"write it in % ({PULSE}), or give `servo_neutral` and `servo_slope` of this servo under `parameters`"
        yield OutOfRange(row, f"{what}, {allowed}; {cure}")


def wrong_height(known: Bench, name: str, test: Test, height: Array, window: Flags) -> Iterator[OutOfRange]:
    """Yield a height that varies, differs from the protocol, or is too low for eq 4.28."""
    inside, row = height[window], _first(window)
    middle = float(np.median(inside))
    if np.ptp(inside) > MAX_HEIGHT_CHANGE * middle:
        cure = "a run has one height; is another column called height?"
        yield OutOfRange(row, f"height goes from {inside.min():.4g} to {inside.max():.4g} m in `window`; {cure}")
        return
    stated = "height" in test.model_fields_set and not isinstance(test, HeightTest)
    if stated and abs(middle - test.height) > MAX_HEIGHT_CHANGE * test.height:
        what = f"height is {middle:.4g} m, and {test.height:g} m in the protocol (tests.{name}.height)"
        yield OutOfRange(row, f"{what}; name its unit, height [mm], or correct one of them")
    lowest = MIN_HEIGHT_RATIO * known.propeller_radius
    if name in ("thrust_line", "ground_effect") and middle < lowest * (1.0 - 1e-6):
        what = f"height is {middle:.4g} m, below half the propeller's radius ({lowest:.4g} m), where eq 4.28 ends"
        yield OutOfRange(row, f"{what}; measure it from the ground to the propeller, or correct `propeller_radius`")


def _first(rows: Flags) -> int:
    return int(np.flatnonzero(rows)[0])
