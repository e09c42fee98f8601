"""Columns of a recording: unit, plausible range and meaning, and their check.

Ranges are wide: they detect wrong units or columns, not poor readings.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cosim.base.arrays import Array, Flags
from cosim.base.messages import Message
from cosim.base.text import counted
from plant.bench import Bench
from plant.identification import messages
from plant.identification.protocol import HeightTest, Test
from plant.powertrain import servo_angle

MAX_HEIGHT = 20.0  # [m]: twice the default height without ground effect, App. D.2; a height in mm or cm exceeds it
MAX_TILT = np.radians(120.0)  # a servo turns by ±90° and some degrees; a duty in other units gives whole turns
MIN_HEIGHT_RATIO = 0.5  # least ratio of height to propeller radius in eq 4.28
MAX_LOWEST_HEIGHT_RATIO = 3.0  # largest ratio for the lowest height of Test 2; above, Γ − 1 is below 1 %
MAX_HEIGHT_CHANGE = 0.1  # share of the height in a window; a bench is fixed


@dataclass(frozen=True)
class BenchColumn:
    """A column of a recording; `high` None stands for the bench's `converter_range`.

    Attributes:
        cure: Advice for a value outside the range, except for voltages.
    """

    unit: str
    low: float
    high: float | None
    meaning: str
    cure: str = ""


DUTY_CURE = f"write it in % of the frame, {messages.PULSE}"
HEIGHT_CURE = f"say its unit, {{name}} [mm]; {MAX_HEIGHT:g} m is as good as no ground"
SPIKE_SHARE = 0.02  # share of readings above which the cause is a unit or a saturated cell
COLUMNS = {
    "duty": BenchColumn("%", 0.0, 100.0, "duty of the speed controller", DUTY_CURE),
    "servo_duty": BenchColumn("%", 0.0, 100.0, "duty of the servo", DUTY_CURE),
    "height": BenchColumn("m", 0.0, MAX_HEIGHT, "height of the propeller over the ground", HEIGHT_CURE),
    "volts_z": BenchColumn("V", 0.0, None, "vertical cell"),
    "volts_x": BenchColumn("V", 0.0, None, "horizontal cell"),
    "volts_m": BenchColumn("V", 0.0, None, "cell of the moment about the tilting axis"),
}


def out_of_range(bench: Bench, values: dict[str, Array]) -> Iterator[tuple[int, Message]]:
    """Yield row and message of the first implausible value of each column, and of an impossible servo duty."""
    is_plausible = True  # the servo duty
    for name, column in COLUMNS.items():
        outside = _outside(bench, column, values[name])
        if not outside.any():
            continue
        is_plausible &= name != "servo_duty"
        row = _first(outside)
        if column.high is None:
            yield row, _voltage_message(bench, name, values[name], outside)
        else:
            fields = {"unit": column.unit, "low": column.low, "high": column.high, "meaning": column.meaning}
            cure = column.cure.format(name=name)
            yield row, messages.VALUE_OUT_OF_RANGE(column=name, value=values[name][row], cure=cure, **fields)
    angle = servo_angle(values["servo_duty"], bench.servo_neutral, bench.servo_slope)
    if is_plausible and (outside := np.abs(angle) > MAX_TILT).any():
        row = _first(outside)
        angles = {"angle": np.degrees(angle[row]), "limit": np.degrees(MAX_TILT)}
        yield row, messages.IMPOSSIBLE_TILT(value=values["servo_duty"][row], **angles)


def _outside(bench: Bench, column: BenchColumn, values: Array) -> Flags:
    """Return True for values outside the range; voltages may exceed it by a step of the converter."""
    if column.high is None:
        step = bench.converter_range / bench.converter_levels
        return np.asarray((values < column.low - step) | (values > bench.converter_range + step))
    outside = (values < column.low) | (values > column.high)
    return np.asarray(outside | (values <= 0.0) if column.unit == "m" else outside)


def _voltage_message(bench: Bench, name: str, values: Array, outside: Flags) -> Message:
    """Return the message of an impossible voltage, by cause."""
    value = values[_first(outside)]
    fields = {"column": name, "value": value, "high": bench.converter_range}
    if outside.mean() < SPIKE_SHARE:
        return messages.VOLTAGE_SPIKE(readings=counted(int(outside.sum()), "reading"), **fields)
    return (messages.NEGATIVE_VOLTAGE if value < 0.0 else messages.VOLTAGE_OUT_OF_RANGE)(**fields)


def wrong_height(bench: Bench, name: str, test: Test, height: Array, window: Flags) -> Iterator[tuple[int, Message]]:
    """Yield row and message of a height that varies, differs from the protocol, or is too low for eq 4.28."""
    inside, row = height[window], _first(window)
    middle = float(np.median(inside))
    if np.ptp(inside) > MAX_HEIGHT_CHANGE * middle:
        yield row, messages.VARYING_HEIGHT(low=inside.min(), high=inside.max())
        return
    stated = "height" in test.model_fields_set and not isinstance(test, HeightTest)
    if stated and abs(middle - test.height) > MAX_HEIGHT_CHANGE * test.height:
        yield row, messages.OTHER_HEIGHT(value=middle, limit=test.height, test=name)
    lowest = MIN_HEIGHT_RATIO * bench.propeller_radius
    if name in ("thrust_line", "ground_effect") and middle < lowest * (1.0 - 1e-6):
        yield row, messages.LOW_HEIGHT(value=middle, limit=lowest)


def _first(rows: Flags) -> int:
    return int(np.flatnonzero(rows)[0])
