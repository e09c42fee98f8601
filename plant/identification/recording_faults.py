"""Faults of recordings: missing phases, swapped or saturated cells."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from cosim.base.arrays import Array, Flags
from cosim.base.errors import Fault
from cosim.base.text import counted
from plant.identification.cells import Cells, at_rail, force_of
from plant.identification.columns import MAX_LOWEST_HEIGHT_RATIO, out_of_range, wrong_height
from plant.identification.command_response import held_lag
from plant.identification.commanded import frequency_of, lacks
from plant.identification.dropouts import dropouts
from plant.identification.equal_readings import EqualReadings, equal_readings
from plant.identification.estimates import Measured
from plant.identification.protocol import CHANNELS, HeightTest, Protocol, SineTest, Test
from plant.identification.recordings import Recording
from plant.identification.thrust_line import LEAST_DUTY, LEAST_ROWS, first_beyond, rows_with_thrust
from plant.powertrain import servo_angle

SWAPPED = "are the channels swapped? Change their names"
MOST_AT_RAIL = {"thrust_line": 1.0 - 0.2, "projection": 0.5}  # share of saturated readings in a window; default 0.05
WANTED = {"thrust_line": "z", "ground_effect": "z", "thrust_step": "z", "projection": "zx", "moment": "m"}  # required
LEAST_FORCE = 3.0  # standard deviations of one reading at rest
PROJECTION = (0.4, 2.5)  # plausible factors on sin α; outside, the column is wrong
OPPOSITE = 130.0  # [°] from the tilt with the assumed lag; lags differ by less than 90°, a mirrored cell by 180°
MAX_TARE = 0.25  # largest tare as a share of the calibration voltages
TIMED = ("step", "thrust_step", "frequency")  # tests of a time
SAME_NOISE = 0.9  # correlation of fourth differences; 0 ± 0.2 for two noisy runs


def recording_faults(
    protocol: Protocol, name: str, recordings: Sequence[Recording], cells: Cells, *, whole: bool = True
) -> list[Fault]:
    """Return every fault of a test's recordings.

    Args:
        whole: True if all files of the test are readable, for joint checks.
    """
    test: Test = getattr(protocol.file.tests, name)
    faults: list[Fault] = []
    for r in recordings:
        found = [] if r.path is None else _out_of_range(protocol, r)
        if r.path is not None and not found:  # planned phases are checked before
            found = [*_missing(protocol, name, test, r), *_wrong_height(protocol, name, test, r)]
        found = found or list(_dropouts(protocol, r))
        faults += found or list(_cells_at_fault(protocol, name, test, r, cells))
    if whole and not faults:
        faults += _of_all(protocol, name, test, recordings)
        if name == "thrust_line":
            faults += _short_ramp(protocol, Measured(recordings, cells, protocol.known, test))
    return faults


def _dropouts(protocol: Protocol, r: Recording) -> Iterator[Fault]:
    """Yield channels with single readings far off their neighbours."""
    if r.path is None:
        return
    for dropout in dropouts(protocol.known, r):
        c, row, others = dropout.channel, int(dropout.rows[0]), dropout.rows.size - 1
        message = f"volts_{c} is {r.volts[c][row]:.4g} V here, and the readings beside it are not"
        message += f" (up to {dropout.distance:.3g} V off)"
        message += f"; so are {counted(others, 'other reading')} of this file" if others else ""
        cure = "delete such rows (single missing rows are filled in), or look at the wires and record it anew"
        yield _at(protocol, r, f"{message}: a dropout; {cure}", row)


def _short_ramp(protocol: Protocol, m: Measured) -> Iterator[Fault]:
    """Yield a fault if the ramps have too little thrust within the range of the cell."""
    if rows_with_thrust(m).enough:
        return
    message = f"the ramp has too little thrust within the cell's range: no line has less than {LEAST_ROWS} readings "
    message += f"over {LEAST_DUTY:g} %; let the window hold more of it"
    if (beyond := first_beyond(m)) is not None:
        r, row = m.recordings[beyond.recording], beyond.row
        place = f"{r.label}:{int(r.lines[row])}" if r.lines.size else r.label
        message += f". The range ends with {r.volts['z'][row]:.3g} V at {r.duty[row]:.4g} %, {place}"
    yield protocol.yaml.fault(("tests", "thrust_line", "window"), message)


def _at(protocol: Protocol, r: Recording, message: str, row: int | None = None) -> Fault:
    if r.path is None:
        return Fault(protocol.yaml.path, 0, 0, f"{r.label}: {message}")
    line = 0 if row is None or not r.lines.size else int(r.lines[row])
    return Fault(Path(r.path), line, 1 if line else 0, message)


def _out_of_range(protocol: Protocol, r: Recording) -> list[Fault]:
    values = {"duty": r.duty, "servo_duty": r.servo_duty, "height": r.height}
    values |= {f"volts_{c}": r.volts[c] for c in CHANNELS}
    return [_at(protocol, r, value.message, value.row) for value in out_of_range(protocol.known, values)]


def _wrong_height(protocol: Protocol, name: str, test: Test, r: Recording) -> Iterator[Fault]:
    if (window := _window(test, r)).any():
        for value in wrong_height(protocol.known, name, test, r.height, window):
            yield _at(protocol, r, value.message, value.row)


def _window(test: Test, r: Recording) -> Flags:
    return np.asarray(r.time >= test.lead + test.skip) if isinstance(test, SineTest) else r.rows(test.window)


def _missing(protocol: Protocol, name: str, test: Test, r: Recording) -> Iterator[Fault]:
    place = f"{protocol.yaml.path.name}: tests.{name}"
    for lack in lacks(protocol.known, name, test, r, place, own=False):
        yield _at(protocol, r, f"{lack.what}; {lack.record}", lack.row)


def _cells_at_fault(protocol: Protocol, name: str, test: Test, r: Recording, cells: Cells) -> Iterator[Fault]:
    """Yield swapped, mirrored, saturated, stuck and coarse channels."""
    window = _window(test, r)
    wanted, at_most = WANTED.get(name, "x"), MOST_AT_RAIL.get(name, 0.05)
    known = protocol.known
    for c in wanted:
        rail = at_rail(known, r.volts[c]) & window
        share = rail.sum() / window.sum()
        if share > at_most:
            row = int(np.flatnonzero(rail)[0])
            cure = "take a cell of a larger range, or less thrust"
            where = f"{r.volts[c][row]:.3g} V, at {100 * share:.0f} % of the readings, first in this row"
            yield _at(protocol, r, f"volts_{c} is at the end of its range, {where}; {cure}", row)
            return
        if r.path is None and np.ptp(r.volts[c][window]) == 0.0:
            yield _at(protocol, r, f"volts_{c} stands still at {r.volts[c][window][0]:.4g} V; does the bench move it?")
            return
        if r.path is None:
            continue
        found = equal_readings(r.volts[c], window, r.rows(test.rest), at_rail(known, r.volts[c]))
        if found and (found.kind != "repeated" or name in TIMED):
            yield _at(protocol, r, f"volts_{c} {_describe(found, r)}", found.row)
            return
    faults = list(_channels_at_fault(protocol, name, test, r, cells))
    yield from faults or _other_cell(protocol, test, r, cells, wanted)


def _describe(found: EqualReadings, r: Recording) -> str:
    """Return a sentence about equal readings, with the cure."""
    if found.kind == "stuck":
        told = f"stands still at {found.value:.4g} V from this row on, for {counted(found.count, 'reading')}"
        return f"{told}; readings have noise, so look at the cell and its wires, and record it anew"
    if found.kind == "clipped":
        told = f"is exactly {found.value:.4g} V, its extreme, at {counted(found.count, 'reading')}, first in this row"
        told += ": the cell or its amplifier is at its end, or stuck"
        return f"{told}; take a larger range or less force, end `window` before, or look at the wires"
    if found.kind == "repeated":
        told = f"repeats each reading {found.value:.2g} times, every {found.value * r.step:.2g} s"
        return f"{told}; record at the rate at which the cell is read, for a time is read off it"
    told = f"is recorded in steps of {found.value:.3g} V and moves by {found.count} of them from rest to `window`"
    return f"{told}; record more digits, or more gain"


def _channels_at_fault(protocol: Protocol, name: str, test: Test, r: Recording, cells: Cells) -> Iterator[Fault]:
    """Yield channels that do not follow the commands."""
    if name == "moment":
        return
    known, window = protocol.known, _window(test, r)
    change, rest = {}, r.rows(test.rest)
    for c in CHANNELS:
        force = force_of(r, cells, c, test.rest)
        force -= force[rest].mean()
        change[c] = (_nearly_all(force[window]) - _nearly_all(force[rest])) / float(np.ptp(cells[c].loads))
    upright = name in ("thrust_line", "ground_effect", "thrust_step")
    if upright:
        other = max("xm", key=lambda c: change[c])
        if change[other] > max(0.2, change["z"]):
            message = f"volts_{other} follows the thrust and volts_z does not, upright: {SWAPPED}"
            yield _at(protocol, r, message, 0)
        elif (force_of(r, cells, "z", test.rest)[window].mean()) < 0:
            message = "the vertical force falls with the duty: volts_z is unplugged, or has the wrong sign or another "
            message += "calibration; look at its plug and at the points of cell z"
            yield _at(protocol, r, message, 0)
    elif name in ("step", "frequency") and change["m"] > max(0.2, change["x"]):
        yield _at(protocol, r, f"volts_m follows the tilt and volts_x does not: {SWAPPED}", 0)
    elif name == "step":
        after = r.rows((test.window[1] - 0.3, test.window[1]))
        fz, fx = (float(force_of(r, cells, c, test.rest)[after].mean()) for c in "zx")
        angle = float(np.mean(servo_angle(r.servo_duty[after], known.servo_neutral, known.servo_slope)))
        one = float(force_of(r, cells, "z", test.rest)[rest].std())
        if max(abs(fz), abs(fx)) < LEAST_FORCE * one:  # noise alone identifies no channel
            told = f"neither volts_z nor volts_x has a force at {np.degrees(angle):.0f}°"
            cure = "beyond what a reading scatters; did the motor run? Record it under thrust"
            yield _at(protocol, r, f"{told}, {cure}", int(np.flatnonzero(after)[0]))
            return
        if abs(angle) < np.radians(40) and abs(fx) > 1.2 * abs(fz):
            message = f"at {np.degrees(angle):.0f}° volts_x says more than volts_z: {SWAPPED}"
            yield _at(protocol, r, message, 0)
            return
    if not upright:
        yield from _projected(protocol, name, test, r, cells)


def _nearly_all(values: Array) -> float:
    """Return the 99 % quantile of sizes."""
    return float(np.quantile(np.abs(values), 0.99))


def _projected(protocol: Protocol, name: str, test: Test, r: Recording, cells: Cells) -> Iterator[Fault]:
    """Yield a horizontal force that differs from thrust times sine in sign or size."""
    known, rows = protocol.known, _window(test, r)
    if isinstance(test, SineTest):
        if (w := frequency_of(r, test)) > min(test.frequencies):  # an unknown lag changes the phase
            yield from _against_sine(protocol, test, r, cells, w)
            return
    elif name == "step":
        rows = r.rows((test.window[1] - 0.3, test.window[1]))
    angle = held_lag(servo_angle(r.servo_duty, known.servo_neutral, known.servo_slope), r.step, known.lag)
    sine, cosine = np.sin(angle[rows]), np.cos(angle[rows])
    fz, fx = (force_of(r, cells, c, test.rest)[rows] for c in "zx")
    factor = float((fx @ sine) / (sine @ sine) / ((fz @ cosine) / (cosine @ cosine)))
    row = int(np.flatnonzero(rows)[0])
    least, most = PROJECTION
    if -most <= factor <= -least:
        told = f"the horizontal force leans against the commanded tilt (factor {factor:.3g} on sin α, 1 is right)"
        cure = "the servo or cell x is mirrored: turn the sign of `servo_slope` under `parameters`, "
        cure += f"{-known.servo_slope:g}, or of the loads of cell x"
        yield _at(protocol, r, f"{told}; {cure}", row)
    elif not least <= factor <= most:
        told = f"the horizontal force is {factor:.3g} times the thrust of volts_z times sin α, and 1 is right"
        cure = f"look at the plug of cell x, the points and units of cells z and x, and at `servo_slope`; {SWAPPED}"
        yield _at(protocol, r, f"{told}; {cure}", row)


def _against_sine(protocol: Protocol, test: SineTest, r: Recording, cells: Cells, w: float) -> Iterator[Fault]:
    """Yield a horizontal force in opposite phase to the commanded sine."""
    from plant.identification.frequency import sine

    known, rows = protocol.known, _window(test, r)
    angle = held_lag(servo_angle(r.servo_duty, known.servo_neutral, known.servo_slope), r.step, known.lag)
    force = force_of(r, cells, "x", test.rest)
    size = sine(r, force, w, test)
    error = float(force[r.rows(test.rest)].std()) * float(np.sqrt(2.0 / rows.sum()))
    phase = float(np.degrees(np.angle(size / sine(r, np.sin(angle), w, test))))
    if abs(size) > LEAST_FORCE * error and abs(phase) > OPPOSITE:
        told = f"the horizontal force leans against the commanded tilt (phase {phase:.0f}° at {w:g} rad/s)"
        cure = "the servo or cell x is mirrored in this run, or its clock is late; look at plug and clock"
        yield _at(protocol, r, f"{told}; {cure}", int(np.flatnonzero(rows)[0]))


def _other_cell(protocol: Protocol, test: Test, r: Recording, cells: Cells, wanted: str) -> Iterator[Fault]:
    """Yield a channel whose rest voltage is far from the unloaded cell's."""
    for c in wanted:
        volts, cell = float(r.volts[c][r.rows(test.rest)].mean()), cells[c]
        if abs(volts - cell.zero) > MAX_TARE * float(np.ptp(cell.volts)):
            told = f"volts_{c} is {volts:.4g} V at rest, and cell {c} without load {cell.zero:.4g} V"
            cure = f"calibrate it anew, or {SWAPPED}"
            yield _at(protocol, r, f"{told}, more than a quarter of its calibration off; {cure}", 0)


def repeated(recordings: Sequence[Recording]) -> list[Fault]:
    """Return a fault for each recording with the noise of an earlier one, a copy.

    Cut, shifted or rounded copies have the same noise too.
    """
    faults = []
    for k, r in enumerate(recordings):
        before = next((q for q in recordings[:k] if q.path != r.path and _same_noise(q, r)), None)
        if before is not None and r.path is not None:
            told = f"holds the readings of {before.label} once more; a repetition is a run of its own, so leave one out"
            faults.append(Fault(Path(r.path), 0, 0, told))
    return faults


def _same_noise(one: Recording, other: Recording) -> bool:
    """Return True if all varying cells have the same noise or equal values."""
    size = min(one.time.size, other.time.size)
    if abs(one.time.size - other.time.size) > 0.5 * size:
        return False
    alike = []
    for c in CHANNELS:
        a, b = (_rough(q.volts[c][:size]) for q in (one, other))
        if scale := float(np.sqrt((a @ a) * (b @ b))):
            alike.append(float(a @ b) / scale)
        elif np.array_equal(one.volts[c][:size], other.volts[c][:size]):
            alike.append(1.0)
    return bool(alike) and float(np.median(alike)) > SAME_NOISE


def _rough(values: Array) -> Array:
    """Return clipped fourth differences, mostly noise."""
    rough = np.diff(values, 4)
    limit = 3.0 * float(np.median(np.abs(rough)))
    return np.asarray(np.clip(rough, -limit, limit) if limit else rough)


def _of_all(protocol: Protocol, name: str, test: Test, recordings: Sequence[Recording]) -> Iterator[Fault]:
    """Yield faults of a test's recordings as a whole."""
    from plant.identification.frequency import grouped
    from plant.identification.protocol import LEAST

    place = ("tests", name, "files") if test.files else ("tests", name)
    if isinstance(test, HeightTest):
        heights: dict[float, int] = {}
        for r in recordings:
            h = min(round(float(np.median(r.height[r.rows(test.window)])), 4), test.free_height)
            heights[h] = heights.get(h, 0) + 1
        if max(heights) < test.free_height:
            cure = f"add runs at {test.free_height:g} m or more, or lower free_height"
            yield protocol.yaml.fault(place, f"the runs with nothing below are missing; {cure}")
        near, limit = min(heights), MAX_LOWEST_HEIGHT_RATIO * protocol.known.propeller_radius
        if near > limit and len(heights) > 1:
            what = f"the lowest height is {near:.4g} m, above {MAX_LOWEST_HEIGHT_RATIO:g} radii of the propeller"
            cure = "there is no ground effect to be seen; is the height in m, and `propeller_radius` right?"
            yield protocol.yaml.fault(place, f"{what} ({limit:.3g} m): {cure}")
        if len(heights) < 3:
            yield protocol.yaml.fault(place, "two heights near the ground are needed at least")
        for h, count in heights.items():
            if count < LEAST:
                yield protocol.yaml.fault(place, f"{count} recordings at {h:g} m are too few; {LEAST} at least")
    if isinstance(test, SineTest):
        found = grouped(recordings, test)
        for w in test.frequencies:
            if len(found.get(w, ())) < LEAST:
                message = f"{len(found.get(w, ()))} recordings at {w:g} rad/s are too few; {LEAST} at least"
                yield protocol.yaml.fault(place, message)
