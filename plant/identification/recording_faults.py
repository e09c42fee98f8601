"""Faults of recordings: missing phases, swapped or saturated cells."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from cosim.base.arrays import Array, Flags, far_beyond
from cosim.base.errors import Fault
from cosim.base.messages import Message
from cosim.base.text import counted
from plant.identification import messages
from plant.identification.cells import Cells, at_rail, force_of
from plant.identification.columns import MAX_LOWEST_HEIGHT_RATIO, out_of_range, wrong_height
from plant.identification.command_response import held_lag
from plant.identification.commanded import frequency_of, lacks
from plant.identification.dropouts import dropouts
from plant.identification.equal_readings import EqualReadings, equal_readings
from plant.identification.estimates import Measurement
from plant.identification.frequency import group_by_frequency, sine
from plant.identification.ground_effect import height_of, sets_by_duty
from plant.identification.protocol import CHANNELS, MIN_REPETITIONS, HeightTest, Protocol, SineTest, Test
from plant.identification.recordings import Recording
from plant.identification.thrust_line import MIN_DUTY_RANGE, MIN_ROWS, first_beyond, rows_with_thrust
from plant.powertrain import servo_angle

MAX_RAIL_SHARE = {"thrust_line": 0.8, "projection": 0.5}  # share of saturated readings in a window; default 0.05
CHANNELS_OF = {"thrust_line": "z", "ground_effect": "z", "thrust_step": "z", "projection": "zx", "moment": "m"}
MIN_FORCE_RATIO = 3.0  # standard deviations of one reading at rest
PROJECTION = (0.4, 1.7)  # plausible factors on sin α; outside, the column is wrong
OPPOSITE = 130.0  # [°] from the tilt with the assumed lag; lags differ by less than 90°, a mirrored cell by 180°
MIN_VOLTAGE_RATIO = 0.1  # least ratio of the highest voltage to the lowest of the calibration
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
    faults = [fault for r in recordings for fault in _Check(protocol, name, r, cells).faults()]
    if whole and not faults:
        test: Test = getattr(protocol.file.tests, name)
        faults += _joint_faults(protocol, name, test, recordings)
        if name == "thrust_line":
            faults += _short_ramp(protocol, Measurement(recordings, cells, protocol.bench, test))
    return faults


class _Check:
    """The checks of a recording by its test; a recording without a file is simulated."""

    def __init__(self, protocol: Protocol, name: str, r: Recording, cells: Cells) -> None:
        self.protocol, self.bench, self.name, self.run, self.cells = protocol, protocol.bench, name, r, cells
        self.test: Test = getattr(protocol.file.tests, name)
        self.rest = r.rows(self.test.rest)
        sines = isinstance(self.test, SineTest)
        self.window: Flags = r.time >= self.test.lead + self.test.skip if sines else r.rows(self.test.window)
        self.channels = CHANNELS_OF.get(name, "x")

    def faults(self) -> list[Fault]:
        """Return the first check's faults, if it has any."""
        if self.run.path is None:  # planned phases are checked before
            return list(self.cell_faults())
        return (
            list(self.range_faults())
            or [*self.command_faults(), *self.height_faults()]
            or list(self.dropout_faults())
            or list(self.cell_faults())
        )

    def fault(self, message: Message, row: int = 0) -> Fault:
        """Return a fault at a row of the recording."""
        if self.run.path is not None:
            return Fault(self.run.path, int(self.run.lines[row]), 1, message)
        message = message.after(f"{self.run.label}: ")
        return Fault(self.protocol.yaml.path, 0, 0, message)

    def force(self, channel: str) -> Array:
        """Return the force of a cell without tare."""
        return force_of(self.run, self.cells, channel, self.test.rest)

    def angle(self) -> Array:
        """Return the commanded angle of the servo."""
        return np.asarray(servo_angle(self.run.servo_duty, self.bench.servo_neutral, self.bench.servo_slope))

    def delayed_angle(self) -> Array:
        """Return the servo's angle, delayed by the assumed lag."""
        return np.asarray(held_lag(self.angle(), self.run.step, self.bench.lag))

    def range_faults(self) -> Iterator[Fault]:
        """Yield a fault for each column's first implausible value."""
        r = self.run
        values = {"duty": r.duty, "servo_duty": r.servo_duty, "height": r.height}
        values |= {f"volts_{c}": r.volts[c] for c in CHANNELS}
        for row, message in out_of_range(self.bench, values):
            yield self.fault(message, row)

    def command_faults(self) -> Iterator[Fault]:
        """Yield a fault for each requirement not met."""
        place = f"{self.protocol.yaml.path.name}: tests.{self.name}"
        for lack in lacks(self.bench, self.name, self.test, self.run, place, own=False):
            yield self.fault(lack.message, lack.row)

    def height_faults(self) -> Iterator[Fault]:
        """Yield a fault for wrong height in the window."""
        if self.window.any():
            for row, message in wrong_height(self.bench, self.name, self.test, self.run.height, self.window):
                yield self.fault(message, row)

    def dropout_faults(self) -> Iterator[Fault]:
        """Yield a fault for each channel with dropouts."""
        for dropout in dropouts(self.bench, self.run):
            c, row, others = dropout.channel, int(dropout.rows[0]), dropout.rows.size - 1
            fields = {"cell": c, "value": self.run.volts[c][row], "distance": dropout.distance}
            if others:
                yield self.fault(messages.DROPOUTS(**fields, others=counted(others, "other reading")), row)
            else:
                yield self.fault(messages.DROPOUT(**fields), row)

    def cell_faults(self) -> Iterator[Fault]:
        """Yield faults of swapped, mirrored, saturated, stuck, coarse channels."""
        r, window = self.run, self.window
        if low := list(self.low_voltages()):
            yield from low
            return
        for c in self.channels:
            volts, rail = r.volts[c], at_rail(self.bench, r.volts[c])
            share = (rail & window).sum() / window.sum()
            if share > MAX_RAIL_SHARE.get(self.name, 0.05):
                row = int(np.flatnonzero(rail & window)[0])
                yield self.fault(messages.AT_RAIL(cell=c, value=volts[row], share=100 * share), row)
                return
            if r.path is None:
                if np.ptp(volts[window]) == 0.0:
                    yield self.fault(messages.CONSTANT_VOLTAGE(cell=c, value=volts[window][0]))
                    return
                continue
            equal = equal_readings(volts, window, self.rest, rail)
            if equal and (equal.kind != "repeated" or self.name in TIMED):
                yield self.fault(self.equal_message(c, equal), equal.row)
                return
        faults = [] if self.name == "moment" else list(self.channel_faults())
        yield from faults or self.tare_faults()

    def low_voltages(self) -> Iterator[Fault]:
        """Yield a fault for each cell whose measured voltage is far below its calibration in every row."""
        for c in "zx" if "x" in self.channels else self.channels:
            top, lowest = float(self.run.volts[c].max()), float(self.cells[c].volts.min())
            if self.run.path is not None and top < MIN_VOLTAGE_RATIO * lowest:
                yield self.fault(messages.LOW_VOLTAGE(cell=c, value=top, limit=lowest))

    def equal_message(self, channel: str, equal: EqualReadings) -> Message:
        """Return the message about equal readings."""
        if equal.kind == "repeated":
            return messages.REPEATED_READINGS(cell=channel, count=equal.value, time=equal.value * self.run.step)
        if equal.kind == "coarse":
            return messages.COARSE_READINGS(cell=channel, value=equal.value, count=equal.count)
        template = messages.STUCK if equal.kind == "stuck" else messages.CLIPPED
        return template(cell=channel, value=equal.value, readings=counted(equal.count, "reading"))

    def channel_faults(self) -> Iterator[Fault]:
        """Yield faults of channels not following the commands."""
        change = {}
        for c in CHANNELS:
            force = self.force(c)
            force -= force[self.rest].mean()
            most, least = (float(np.quantile(np.abs(force[rows]), 0.99)) for rows in (self.window, self.rest))
            change[c] = (most - least) / float(np.ptp(self.cells[c].loads))
        if self.name in ("thrust_line", "ground_effect", "thrust_step"):
            other = max("xm", key=lambda c: change[c])
            if change[other] > max(0.2, change["z"]):
                yield self.fault(messages.THRUST_IN_OTHER_CELL(cell=other))
            elif self.force("z")[self.window].mean() < 0:
                yield self.fault(messages.NEGATIVE_THRUST())
            return
        if self.name in ("step", "frequency") and change["m"] > max(0.2, change["x"]):
            yield self.fault(messages.TILT_IN_MOMENT_CELL())
        elif self.name == "step" and (faults := list(self.end_faults())):
            yield from faults
            return
        yield from self.projection_faults()

    def end_of_step(self) -> Flags:
        """Return the last rows of the window."""
        return self.run.rows((self.test.window[1] - 0.3, self.test.window[1]))

    def end_faults(self) -> Iterator[Fault]:
        """Yield faults if the forces at the end of a step are too small or do not match the angle."""
        after = self.end_of_step()
        fz, fx = (float(self.force(c)[after].mean()) for c in "zx")
        angle = float(np.mean(self.angle()[after]))
        noise = float(self.force("z")[self.rest].std())
        if max(abs(fz), abs(fx)) < MIN_FORCE_RATIO * noise:  # noise alone identifies no channel
            yield self.fault(messages.NO_FORCE(angle=np.degrees(angle)), int(np.flatnonzero(after)[0]))
        elif abs(angle) < np.radians(40) and abs(fx) > 1.2 * abs(fz):
            yield self.fault(messages.LARGE_HORIZONTAL_FORCE(angle=np.degrees(angle)))

    def projection_faults(self) -> Iterator[Fault]:
        """Yield a fault if the horizontal force differs from thrust times sine in sign or size."""
        rows = self.end_of_step() if self.name == "step" else self.window
        if isinstance(self.test, SineTest) and (w := frequency_of(self.run, self.test)) > min(self.test.frequencies):
            yield from self.phase_faults(self.test, w)  # an unknown lag changes the phase
            return
        angle = self.delayed_angle()[rows]
        along = [self.force(c)[rows] @ f(angle) / (f(angle) @ f(angle)) for c, f in (("x", np.sin), ("z", np.cos))]
        factor, row = float(along[0] / along[1]), int(np.flatnonzero(rows)[0])
        least, most = PROJECTION
        if -most <= factor <= -least:
            yield self.fault(messages.MIRRORED_FORCE(factor=factor, slope=-self.bench.servo_slope), row)
        elif not least <= factor <= most:
            yield self.fault(messages.WRONG_HORIZONTAL_FORCE(factor=factor), row)

    def phase_faults(self, test: SineTest, w: float) -> Iterator[Fault]:
        """Yield a fault for a force of opposite phase."""
        force = self.force("x")
        size = sine(self.run, force, w, test)
        error = float(force[self.rest].std()) * float(np.sqrt(2.0 / self.window.sum()))
        phase = float(np.degrees(np.angle(size / sine(self.run, np.sin(self.delayed_angle()), w, test))))
        if abs(size) > MIN_FORCE_RATIO * error and abs(phase) > OPPOSITE:
            row = int(np.flatnonzero(self.window)[0])
            yield self.fault(messages.OPPOSITE_PHASE(phase=phase, frequency=w), row)

    def tare_faults(self) -> Iterator[Fault]:
        """Yield a fault for each implausible rest voltage."""
        for c in self.channels:
            volts, cell = float(self.run.volts[c][self.rest].mean()), self.cells[c]
            if abs(volts - cell.zero) > MAX_TARE * float(np.ptp(cell.volts)):
                yield self.fault(messages.OTHER_CELL(cell=c, value=volts, zero=cell.zero))


def copy_faults(recordings: Sequence[Recording]) -> list[Fault]:
    """Return a fault for each recording that is a copy: its noise equals that of an earlier one.

    Cut, shifted or rounded copies have the same noise too.
    """
    faults: list[Fault] = []
    for k, r in enumerate(recordings):
        earlier = next((q for q in recordings[:k] if q.path != r.path and _has_noise_of(q, r)), None)
        if earlier is not None and r.path is not None:
            faults.append(Fault(r.path, 0, 0, messages.COPY(name=earlier.label)))
    return faults


@far_beyond
def _has_noise_of(one: Recording, other: Recording) -> bool:
    """Return True if all varying cells of two recordings have the same noise or equal values."""
    size = min(one.time.size, other.time.size)
    if abs(one.time.size - other.time.size) > 0.5 * size:
        return False
    correlations = []
    for c in CHANNELS:
        a, b = (_noise(q.volts[c][:size]) for q in (one, other))
        if scale := float(np.sqrt((a @ a) * (b @ b))):
            correlations.append(float(a @ b) / scale)
        elif np.array_equal(one.volts[c][:size], other.volts[c][:size]):
            correlations.append(1.0)
    return bool(correlations) and float(np.median(correlations)) > SAME_NOISE


def _noise(values: Array) -> Array:
    """Return clipped fourth differences, mostly noise."""
    differences = np.diff(values, 4)
    limit = 3.0 * float(np.median(np.abs(differences)))
    return np.asarray(np.clip(differences, -limit, limit) if limit else differences)


def _short_ramp(protocol: Protocol, m: Measurement) -> Iterator[Fault]:
    """Yield a fault if the ramps have too little thrust within the range of the cell."""
    if rows_with_thrust(m).is_sufficient:
        return
    message = messages.SHORT_RAMP(rows=MIN_ROWS, least=MIN_DUTY_RANGE)
    if (beyond := first_beyond(m)) is not None:
        r, row = m.recordings[beyond.recording], beyond.row
        place = f"{r.label}:{int(r.lines[row])}" if r.lines.size else r.label
        fields = {"value": r.volts["z"][row], "duty": r.duty[row], "place": place}
        message = messages.RAMP_BEYOND_RANGE(rows=MIN_ROWS, least=MIN_DUTY_RANGE, **fields)
    yield protocol.yaml.fault(("tests", "thrust_line", "window"), message)


def _joint_faults(protocol: Protocol, name: str, test: Test, recordings: Sequence[Recording]) -> Iterator[Fault]:
    """Yield faults of a test's recordings as a whole."""
    fault, place = protocol.yaml.fault, ("tests", name, "files") if test.files else ("tests", name)
    if isinstance(test, HeightTest):
        heights = Counter(height_of(r, test) for r in recordings)
        if max(heights) < test.free_height:
            yield fault(place, messages.NO_FREE_HEIGHT(height=test.free_height))
        limit = MAX_LOWEST_HEIGHT_RATIO * protocol.bench.propeller_radius
        if (near := min(heights)) > limit and len(heights) > 1:
            yield fault(place, messages.NO_LOW_HEIGHT(height=near, ratio=MAX_LOWEST_HEIGHT_RATIO, limit=limit))
        if len(heights) < 3:
            yield fault(place, messages.TOO_FEW_LOW_HEIGHTS())
        for h, count in heights.items():
            if count < MIN_REPETITIONS:
                yield fault(place, messages.TOO_FEW_AT_HEIGHT(count=count, height=h, least=MIN_REPETITIONS))
        yield from _incomplete_sets(test, recordings)
    if isinstance(test, SineTest):
        by_frequency = group_by_frequency(recordings, test)
        for w in test.frequencies:
            if (count := len(by_frequency.get(w, ()))) < MIN_REPETITIONS:
                yield fault(place, messages.TOO_FEW_AT_FREQUENCY(count=count, frequency=w, least=MIN_REPETITIONS))


def _incomplete_sets(test: HeightTest, recordings: Sequence[Recording]) -> Iterator[Fault]:
    """Yield a fault for each measured run of another duty, if that duty was not recorded at every height."""
    main, *others = sets_by_duty(recordings, test)
    usual = _duty_in_window(next(iter(main.values()))[0], test)
    lone = [chosen for chosen in others if main.keys() - chosen.keys()]
    for r in (r for chosen in lone for group in chosen.values() for r in group):
        if r.path is not None:
            message = messages.OTHER_DUTY(duty=_duty_in_window(r, test), usual=usual)
            yield Fault(r.path, int(r.lines[np.flatnonzero(r.rows(test.window))[0]]), 1, message)


def _duty_in_window(r: Recording, test: Test) -> float:
    return float(np.median(r.duty[r.rows(test.window)]))
