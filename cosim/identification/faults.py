"""What keeps recordings from telling anything: a phase that is missing, cells swapped or at their end."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from cosim.errors import Fault
from cosim.identification.cells import Cells, at_rail, force_of
from cosim.identification.commanded import lacks
from cosim.identification.protocol import CHANNELS, HeightTest, Protocol, SineTest, Test
from cosim.identification.recordings import Recording
from cosim.identification.thrust_line import LEAST_DUTY, LEAST_ROWS, rows_with_thrust
from plant.powertrain import servo_angle

SWAPPED = "are the channels swapped? Change their names"
MOST_AT_RAIL = 0.5  # of the readings of a window
LEAST_FORCE = 3.0  # standard deviations of one reading at rest


def recording_faults(protocol: Protocol, name: str, recordings: Sequence[Recording], cells: Cells) -> list[Fault]:
    """Every fault of the recordings of a test, at their file and row."""
    test: Test = getattr(protocol.file.tests, name)
    faults: list[Fault] = []
    for r in recordings:
        found = (
            [] if r.path is None else list(_missing(protocol, name, test, r))
        )  # phases were asked before they played
        faults += found or list(_cells_at_fault(protocol, name, test, r, cells))
    if not faults:
        faults += _of_all(protocol, name, test, recordings)
        if name == "thrust_line" and not rows_with_thrust(recordings, cells, protocol.known, test).enough:
            cure = f"no line has less than {LEAST_ROWS} readings over {LEAST_DUTY:g} %; let the window hold more of it"
            where = ("tests", name, "window")
            faults.append(protocol.yaml.fault(where, f"the ramp has too little thrust within the cell's range: {cure}"))
    return faults


def _at(protocol: Protocol, r: Recording, message: str, row: int | None = None) -> Fault:
    if r.path is None:
        return Fault(protocol.yaml.path, 0, 0, f"{r.label}: {message}")
    line = 0 if row is None or not r.lines.size else int(r.lines[row])
    return Fault(Path(r.path), line, 1 if line else 0, message)


def _missing(protocol: Protocol, name: str, test: Test, r: Recording) -> Iterator[Fault]:
    place = f"{protocol.yaml.path.name}: tests.{name}"
    for lack in lacks(protocol.known, name, test, r, place, own=False):
        yield _at(protocol, r, f"{lack.what}; {lack.record}", lack.row)


def _cells_at_fault(protocol: Protocol, name: str, test: Test, r: Recording, cells: Cells) -> Iterator[Fault]:
    """Swapped and saturated channels."""
    window = r.time >= test.lead + test.skip if isinstance(test, SineTest) else r.rows(test.window)
    wanted = {"thrust_line": "z", "ground_effect": "z", "thrust_step": "z", "projection": "zx", "moment": "m"}.get(
        name, "x"
    )
    known = protocol.known
    beyond = [fault for c in CHANNELS for fault in _beyond(protocol, r, c)]
    if beyond:
        yield from beyond
        return
    for c in wanted:
        rail = at_rail(known, r.volts[c]) & window
        share = rail.sum() / window.sum()
        if share > (1.0 - 0.2 if name == "thrust_line" else MOST_AT_RAIL if name == "projection" else 0.05):
            row = int(np.flatnonzero(rail)[0])
            cure = "take a cell of a larger range, or less thrust"
            where = f"{r.volts[c][row]:.3g} V, at {100 * share:.0f} % of the readings, first in this row"
            yield _at(protocol, r, f"volts_{c} is at the end of its range, {where}; {cure}", row)
            return
        if np.ptp(r.volts[c][window]) == 0.0:
            row = int(np.flatnonzero(window)[0])
            cure = "readings have noise, so look at the cell and its wires, and record it anew"
            yield _at(protocol, r, f"volts_{c} stands still at {r.volts[c][row]:.4g} V from this row on; {cure}", row)
            return
    if name == "moment":
        return
    change = {}
    rest = r.rows(test.rest)
    for c in CHANNELS:
        scale = float(np.ptp(cells[c].loads))
        force = force_of(r, cells, c, test.rest)
        change[c] = (
            float(np.abs(force[window] - force[rest].mean()).max() - np.abs(force[rest] - force[rest].mean()).max())
            / scale
        )
    upright = name in ("thrust_line", "ground_effect", "thrust_step")
    if upright:
        other = max("xm", key=lambda c: change[c])
        if change[other] > max(0.2, change["z"]):
            message = f"volts_{other} follows the thrust and volts_z does not, upright: {SWAPPED}"
            yield _at(protocol, r, message, 0)
        elif (force_of(r, cells, "z", test.rest)[window].mean()) < 0:
            yield _at(
                protocol,
                r,
                "the vertical force falls with the duty: volts_z has the wrong sign or another calibration",
                0,
            )
    elif name in ("step", "frequency") and change["m"] > max(0.2, change["x"]):
        yield _at(protocol, r, f"volts_m follows the tilt and volts_x does not: {SWAPPED}", 0)
    elif name == "step":
        after = r.rows((test.window[1] - 0.3, test.window[1]))
        fz, fx = (float(force_of(r, cells, c, test.rest)[after].mean()) for c in "zx")
        angle = float(np.mean(servo_angle(r.servo_duty[after], known.servo_neutral, known.servo_slope)))
        one = float(force_of(r, cells, "z", test.rest)[rest].std())
        if max(abs(fz), abs(fx)) < LEAST_FORCE * one:  # noise against noise tells of no channel
            told = (
                f"neither volts_z nor volts_x has a force at {np.degrees(angle):.0f}°, beyond what a reading scatters"
            )
            yield _at(protocol, r, f"{told}; did the motor run? Record it under thrust", int(np.flatnonzero(after)[0]))
            return
        if abs(angle) < np.radians(40) and abs(fx) > 1.2 * abs(fz):
            message = f"at {np.degrees(angle):.0f}° volts_x says more than volts_z: {SWAPPED}"
            yield _at(protocol, r, message, 0)


def _beyond(protocol: Protocol, r: Recording, channel: str) -> Iterator[Fault]:
    """Readings that no converter gives: the voltage is in another unit, mostly."""
    top, volts = protocol.known.converter_range, r.volts[channel]
    step = top / protocol.known.converter_levels
    out = np.flatnonzero((volts < -step) | (volts > top + step))
    if out.size:
        name, row = f"volts_{channel}", int(out[0])
        cure = f"say its unit in the column's name, {name} [mV], or `converter_range` under `parameters`"
        yield _at(protocol, r, f"{name} is {volts[row]:.4g} V here, beyond the converter's 0 to {top:g} V; {cure}", row)


def repeated(recordings: Sequence[Recording]) -> list[Fault]:
    """Recordings of a test that hold the same readings as one before: they are no repetitions."""
    first: dict[bytes, Recording] = {}
    faults = []
    for r in recordings:
        before = first.setdefault(b"".join(r.volts[c].tobytes() for c in CHANNELS), r)
        if before is not r and r.path is not None:
            told = f"holds the readings of {before.label} once more; a repetition is a run of its own, so leave one out"
            faults.append(Fault(Path(r.path), 0, 0, told))
    return faults


def _of_all(protocol: Protocol, name: str, test: Test, recordings: Sequence[Recording]) -> Iterator[Fault]:
    """What only all recordings of a test together can lack."""
    from cosim.identification.frequency import grouped
    from cosim.identification.protocol import LEAST

    place = ("tests", name, "files") if test.files else ("tests", name)
    if isinstance(test, HeightTest):
        heights: dict[float, int] = {}
        for r in recordings:
            h = min(round(float(np.median(r.height[r.rows(test.window)])), 4), test.free_height)
            heights[h] = heights.get(h, 0) + 1
        if max(heights) < test.free_height:
            cure = f"add runs at {test.free_height:g} m or more, or lower free_height"
            yield protocol.yaml.fault(place, f"the runs with nothing below are missing; {cure}")
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
