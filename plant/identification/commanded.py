"""Requirements of each test on its commands, for recordings and for planned phases."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cosim.base.arrays import Array, Flags
from plant.bench import REST_DUTY, Bench
from plant.identification.protocol import HoldTest, SineTest, StepTest, Test
from plant.identification.recordings import Recording
from plant.powertrain import servo_angle

LEAST_DUTY, LEAST_ANGLE = 0.1, np.radians(5)  # [%, rad] least variation for a line and a moment
LEAST_STEP = 0.02  # [%] of the duty
SAME_DUTY = 0.01  # [%] difference of means within one command: two decimals, rounded
UPRIGHT = np.radians(2.5)  # cos deviates by 0.1 % from 1
LEAST_ROWS = 10
ROWS_PER_PERIOD = 10  # rows in a period of a sine
LEAST_BEFORE = 3  # rows before a step
BEFORE = 0.3  # [s] before a step in a fit
UNSETTLED = 0.1  # share of a window that may contain the previous transient
JUMP = 3.0  # multiple of a ramp's step from row to row beyond which a jump is no ramp
SLOWEST = 0.2  # share of a sine's fastest change from which a row belongs to the sine
SAME_FREQUENCY = 0.005  # difference of a frequency that is written with three digits, as a share
FREQUENCY_ERRORS = 4.0  # standard errors within which frequencies are equal
SETTLED = 3.0  # lags and low passes until the thrust has settled to 5 % of a change


@dataclass(frozen=True)
class Lack:
    """A deficiency of a run: key of its test, row, and cures for a recording and a protocol."""

    key: str
    row: int
    what: str
    record: str
    plan: str


def windows_of(test: Test) -> dict[str, tuple[float, float]]:
    """Return the windows of a test by key; a sine test uses all rows after its lead."""
    found = {"rest": test.rest, "window": test.window}
    if isinstance(test, HoldTest):
        found["hold"] = test.hold
    if isinstance(test, SineTest):
        del found["window"]
    return found


def lacks(known: Bench, name: str, test: Test, r: Recording, place: str, *, own: bool) -> Iterator[Lack]:
    """Yield all deficiencies of a run for its test.

    Args:
        place: Place of the test in its protocol, for a cure.
        own: True if the thrust line in `known` is simulated and gives the duty of zero thrust.
    """
    missing = list(_windows(test, r, place))
    yield from missing
    if missing:
        return
    see = _Seen(known, name, test, r, own)
    if name != "moment" and see.top <= see.idle:
        begins = f", and thrust begins above {see.idle:.2f} %" if own else ""
        begins += ", as of a share of one, duty [1]" if 0.0 < see.top <= 1.0 else ""
        yield Lack(
            "duty" if isinstance(test, SineTest) else "phases",
            0,
            f"duty is {see.top:g} % at most{begins}: the phase with thrust is missing",
            "record it",
            "add it",
        )
        return
    rested = see.duty[see.rest].max()
    if (name != "moment" and rested >= see.duty[~see.rest].max(initial=-np.inf)) or (
        rested > max(REST_DUTY, see.duty.min()) + LEAST_DUTY
    ):
        what = f"the phase at rest is missing: duty is {rested:g} % there already"
        plan = f"rest before the duty rises above {REST_DUTY:g} %, for the tare"
        yield Lack("rest", see.first(see.rest), what, "begin each run with the motor off, for the tare", plan)
        return
    ways = {"thrust_line": _ramp, "projection": _projection, "step": _step, "thrust_step": _step, "moment": _moment}
    yield from ways.get(name, _sine if isinstance(test, SineTest) else _steady_window)(see, place)


def _windows(test: Test, r: Recording, place: str) -> Iterator[Lack]:
    ends = f"it lasts from {r.time[0]:.10g} to {r.time[-1]:.10g} s"
    if test.rest[1] < r.time[0] and r.time[-1] - r.time[0] >= max(end for _, end in windows_of(test).values()):
        ends += ", a clock that does not begin at 0 s"
    for key, (start, end) in windows_of(test).items():
        covered = r.time[0] <= start + 1.5 * r.step and end <= r.time[-1] + 1.5 * r.step
        if (count := int(r.rows((start, end)).sum())) >= LEAST_ROWS and covered:
            continue
        if covered and r.step > (end - start) / LEAST_ROWS:
            what = f"rows are {r.step:g} s apart, so that `{key}` from {start:g} to {end:g} s holds {count}"
            cure = "if the time is in milliseconds, name its column time [ms]; else record faster"
            yield Lack(key, 1, f"{what}, {LEAST_ROWS} at least", cure, f"lengthen it, or lower `step` below {r.step:g}")
        else:
            what = f"the phase `{key}` from {start:g} to {end:g} s is missing, {ends}"
            yield Lack(key, r.time.size - 1, what, f"record it, or change {place}.{key}", "move it or add a phase")


def moves(duty: Array) -> bool:
    """Return True for a changing duty, in total or from first to last quarter."""
    quarter = max(1, duty.size // 4)
    return bool(np.ptp(duty) > LEAST_DUTY or abs(duty[:quarter].mean() - duty[-quarter:].mean()) > SAME_DUTY)


class _Seen:
    """A run from the view of its test: commands, and rows at rest and in the window."""

    def __init__(self, known: Bench, name: str, test: Test, r: Recording, own: bool) -> None:
        self.name, self.test, self.run, self.known = name, test, r, known
        self.duty, self.angle = r.duty, servo_angle(r.servo_duty, known.servo_neutral, known.servo_slope)
        self.rest = r.rows(test.rest)
        self.seen: Flags = r.time >= test.lead + test.skip if isinstance(test, SineTest) else r.rows(test.window)
        self.top = float(self.duty.max())
        self.idle = -known.thrust_offset / known.thrust_slope if own else REST_DUTY

    def first(self, rows: Flags) -> int:
        """Return the first of these rows."""
        return int(np.flatnonzero(rows)[0])

    def without_thrust(self, rows: Flags, key: str, where: str) -> Iterator[Lack]:
        """Yield a deficiency if the motor does not run in some rows."""
        idle = max(self.idle, float(self.duty[self.rest].max()))
        low = rows & (self.duty <= idle)
        if low.any():
            what = f"duty is {self.duty[low].min():.4g} % {where}, where thrust begins above {idle:.4g} %"
            yield Lack(key, self.first(low), what, "record it under thrust", "move it to where there is thrust")

    def tilted(self, rows: Flags, key: str, where: str) -> Iterator[Lack]:
        """Yield a deficiency if some rows are not upright."""
        over = rows & (np.abs(self.angle) > UPRIGHT)
        if over.any():
            most = np.degrees(np.abs(self.angle[over]).max())
            what = f"the tilt is up to {most:.1f}° {where}, which is read upright ({np.degrees(UPRIGHT):g}° or less)"
            yield Lack(key, self.first(over), what, "record it upright", "move it to where it is upright")

    def unsteady(self, window: tuple[float, float], key: str, where: str) -> Iterator[Lack]:
        """Yield a deficiency if the duty changes in or shortly before a window."""
        before = SETTLED * (self.known.lag + self.test.low_pass)
        rows = self.run.rows((window[0] - before, window[1]))
        if moves(self.duty[rows]):
            low, high = self.duty[rows].min(), self.duty[rows].max()
            what = f"the duty goes from {low:.4g} to {high:.4g} % {where}, or in the {before:.2g} s before, in which "
            what += "thrust and low pass settle"
            yield Lack(key, self.first(rows), what, "record it at one duty", "move it to where the duty stands")


def _ramp(see: _Seen, place: str) -> Iterator[Lack]:
    start, end = see.test.window
    with_thrust = see.seen & (see.duty > see.idle)
    if np.ptp(see.duty[see.seen]) < LEAST_DUTY:
        what = f"the duty does not vary from {start:g} to {end:g} s: the ramp is missing"
        yield Lack("window", see.first(see.seen), what, "record it", "move the window to it")
    elif not with_thrust.any() or np.ptp(see.duty[with_thrust]) < LEAST_DUTY:
        what = f"of the ramp from {start:g} to {end:g} s less than {LEAST_DUTY:g} % is above {see.idle:.2f} %"
        cure, row = "move the window, or let the ramp go higher", see.first(see.seen)
        yield Lack("window", row, f"{what}, where thrust begins", "record a ramp that goes higher", cure)
    before = see.run.rows((start - (long := SETTLED * (see.known.lag + see.test.low_pass)), start))
    moved, ramp = (np.abs(np.diff(see.duty[rows])) for rows in (before, see.seen))
    at = float(see.run.time[before][1 + int(np.argmax(moved))]) if moved.size else -np.inf
    jumps = moved.max(initial=0.0) > max(LEAST_STEP, JUMP * ramp.max(initial=0.0))
    if jumps and at + long - start > UNSETTLED * (end - start):
        what = (
            f"the duty jumps at {at:.4g} s, and `window` begins at {start:g} s, before thrust and low pass have settled"
        )
        cure = f"let it begin {long:.2g} s after the jump, at {at + long:.4g} s"
        yield Lack("window", see.first(see.seen), what, f"{cure}: change {place}.window", cure)
    yield from see.tilted(see.seen, "window", "in `window`")


def _steady_window(see: _Seen, place: str) -> Iterator[Lack]:
    idle = list(see.without_thrust(see.seen, "window", "in `window`"))
    yield from idle or see.unsteady(see.test.window, "window", "in `window`")
    yield from see.tilted(see.seen, "window", "in `window`")


def _projection(see: _Seen, place: str) -> Iterator[Lack]:
    assert isinstance(see.test, HoldTest)
    if np.ptp(see.angle[see.seen]) < LEAST_ANGLE:
        what = "the tilt does not vary in the window: the sweep of servo_duty is missing"
        yield Lack("window", see.first(see.seen), what, "record it", "move the window to it")
    hold = see.run.rows(see.test.hold)
    idle = list(see.without_thrust(see.seen, "window", "in `window`"))
    idle += see.without_thrust(hold, "hold", "in `hold`")
    yield from idle
    settling = see.run.rows((see.test.hold[0] - SETTLED * (see.known.lag + see.test.low_pass), see.test.hold[1]))
    yield from see.tilted(settling, "hold", "in `hold` or shortly before")
    if idle:
        return
    yield from see.unsteady(see.test.window, "window", "in `window`")
    yield from (unsteady := list(see.unsteady(see.test.hold, "hold", "in `hold`")))
    held, swept = float(see.duty[hold].mean()), float(see.duty[see.seen].mean())
    if not unsteady and abs(held - swept) > SAME_DUTY:
        what = f"duty is {held:.4g} % in `hold` and {swept:.4g} % in `window`: forces are told by the thrust of `hold`"
        yield Lack("hold", see.first(hold), what, "record both at one duty", "have both at one duty")


def _step(see: _Seen, place: str) -> Iterator[Lack]:
    assert isinstance(see.test, StepTest)
    r, at, (start, end) = see.run, see.test.at, see.test.window
    thrust = see.name == "thrust_step"
    if thrust:
        own, other, what, other_name, least = see.duty, see.angle, "duty", "servo_duty", LEAST_STEP
    else:
        own, other, what, other_name, least = see.angle, see.duty, "servo_duty", "duty", LEAST_ANGLE
    row = min(int(np.searchsorted(r.time, at)), r.time.size - 1)
    near = (r.time >= at - 2.5 * r.step) & (r.time <= at + 2.5 * r.step)
    step = np.abs(np.diff(own[near])).max(initial=0.0)
    if step < least:
        if 10.0 * step > least:
            size, need = (f"{v:.3g} %" if thrust else f"{np.degrees(v):.3g}°" for v in (step, least))
            cure = f"let it step by {need} at least"
            yield Lack("at", row, f"{what} steps by {size} at {at:g} s, less than {need}", cure, cure)
        else:  # slower motion is no step
            plan = f"phases of two values at one time make a step; {_steps(own, r.time, least)}"
            yield Lack("at", row, f"{what} has no step at {at:g} s", f"say when it is in {place}.at", plan)
        return
    if not start - 0.5 * r.step <= at <= end:
        told = f"`window` from {start:g} to {end:g} s does not hold the step `at` {at:g} s"
        cure = f"change {place}.window, or {place}.at"
        yield Lack("window", row, told, cure, "let it begin with the step, and end when its answer has settled")
        return
    after, before = (int(rows.sum()) for rows in (r.rows((at, end)), r.time < at - 0.5 * r.step))
    if after < LEAST_ROWS or before < LEAST_BEFORE:
        told = f"{after} rows stand after the step at {at:g} s in `window`, and {int((r.time < at).sum())} before it"
        cure = f"{LEAST_ROWS} after it and {LEAST_BEFORE} before it are needed"
        yield Lack("window", row, f"{told}; {cure}", f"change {place}.window", "move its end, or the step")
        return
    yield from _upright_end(see, row)
    yield from see.without_thrust(r.rows((at, end)), "window", "after the step")
    begin = max(float(r.time[0]), at - BEFORE - SETTLED * (see.known.lag + see.test.low_pass))
    seen = r.rows((begin, end))
    if np.ptp(other[seen]) > LEAST_ANGLE if thrust else moves(other[seen]):
        told = f"{other_name} changes too about the step of {what}, from {begin:.4g} to {end:g} s"
        yield Lack("window", row, told, "record the step alone", "let the other stand from before the step on")


def _upright_end(see: _Seen, row: int) -> Iterator[Lack]:
    """Yield a deficiency if a step of the tilt ends without a horizontal force."""
    last = abs(float(np.mean(see.angle[see.seen][-LEAST_BEFORE:])))
    if see.name == "step" and last < UPRIGHT:
        told = f"the step ends at {np.degrees(last):.1f}°, upright, where a tilt has no horizontal force"
        yield Lack("window", row, told, "record a step that ends tilted", "let it end tilted")


def _steps(signal: Array, time: Array, least: float) -> str:
    """Return the step times of a command."""
    found = time[1:][np.abs(np.diff(signal)) >= least]
    return f"there is one at {', '.join(f'{t:g}' for t in found[:3])} s" if 0 < found.size < 20 else "there is none"


def _sine(see: _Seen, place: str) -> Iterator[Lack]:
    assert isinstance(see.test, SineTest)
    lead = see.test.lead
    if see.seen.sum() < LEAST_ROWS or np.ptp(see.angle[see.seen]) < np.radians(1):
        what = f"there is no sine of servo_duty after {lead:g} s"
        yield Lack("amplitude", 0, what, f"record it, or change {place}.lead", "give it 1° at least")
        return
    idle = list(see.without_thrust(see.seen, "duty", "under the sine"))
    yield from idle
    if not idle and moves(see.duty[see.seen]):
        low, high = see.duty[see.seen].min(), see.duty[see.seen].max()
        what = f"the duty goes from {low:.4g} to {high:.4g} % under the sine"
        yield Lack("duty", see.first(see.seen), what, "record it at one duty", "keep it")
    w = frequency_of(see.run, see.test)
    place_of_w = see.test.frequencies.index(w)
    skips = [*see.test.thesis_skip, *(0.0 for _ in see.test.frequencies)]
    needed = lead + max(see.test.skip, skips[place_of_w] * 2.0 * np.pi / w) + 2.0 * np.pi / w
    if see.run.time[-1] < needed - 1.5 * see.run.step:
        what = f"the sine of {w:g} rad/s ends at {see.run.time[-1]:.4g} s, before a whole period after what is skipped"
        cure = f"until {needed:.4g} s"
        yield Lack("periods", see.run.time.size - 1, what, f"record it {cure}", f"play it {cure}")
    if see.run.path is not None:
        yield from _other_frequency(see, w, place)
    if see.run.path is not None and w * see.run.step > 2.0 * np.pi / ROWS_PER_PERIOD * (1.0 + 1e-3):
        what = f"rows are {see.run.step:.4g} s apart, fewer than {ROWS_PER_PERIOD} in a period of {w:g} rad/s"
        most = f"{2.0 * np.pi / w / ROWS_PER_PERIOD:.3g} s or less"
        yield Lack("frequencies", 1, what, f"record it at {most}, or leave it out", f"lower `step` to {most}")


def frequency_of(r: Recording, test: SineTest) -> float:
    """Return the protocol's frequency [rad/s] closest to the command of a run."""
    rows = r.time >= test.lead
    t, y = r.time[rows] - test.lead, r.servo_duty[rows] - r.servo_duty[rows].mean()

    def missed(w: float) -> float:
        basis = np.column_stack((np.sin(w * t), np.cos(w * t), np.ones_like(t)))
        rest = y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0]
        return float(rest @ rest)

    return min(test.frequencies, key=missed)


def _other_frequency(see: _Seen, w: float, place: str) -> Iterator[Lack]:
    """Yield a deficiency if the command has another frequency than the protocol."""
    assert isinstance(see.test, SineTest)
    after = np.flatnonzero(see.run.time >= see.test.lead - 0.5 * see.run.step)
    changes = np.abs(np.diff(see.run.servo_duty[after]))
    moving = np.flatnonzero(changes > SLOWEST * np.quantile(changes[changes > 0.0], 0.9))
    rows = after[moving[0] : moving[-1] + 1]  # without rests before and after the sine
    time, command = see.run.time[rows], see.run.servo_duty[rows]
    if rows.size < LEAST_ROWS or w * (time[-1] - time[0]) < np.pi:
        return
    fitted, error = fit_frequency(time, command, w)
    if abs(fitted - w) <= SAME_FREQUENCY * w + FREQUENCY_ERRORS * error:
        return
    what = f"the sine of servo_duty is {fitted:.3g} rad/s, and the protocol has {w:g} rad/s"
    cure = f"look at the clock of the recording, or change {place}.frequencies"
    yield Lack("frequencies", int(rows[0]), what, cure, cure)


def fit_frequency(time: Array, command: Array, near: float) -> tuple[float, float]:
    """Return frequency and standard error [rad/s] of a sine plus constant, between half and twice `near`."""
    from scipy.optimize import minimize_scalar

    t = time - time.mean()

    def misfit(w: float) -> float:
        basis = np.column_stack((np.sin(w * t), np.cos(w * t), np.ones_like(t)))
        rest = command - basis @ np.linalg.lstsq(basis, command, rcond=None)[0]
        return float(rest @ rest)

    length = float(t[-1] - t[0])
    apart = 0.5 / length  # a tenth of the main lobe of the sine, 2·2π / length, or less
    grid = np.arange(0.5 * near, 2.0 * near + apart, apart)
    best = float(grid[np.argmin([misfit(w) for w in grid])])
    fitted = float(minimize_scalar(misfit, bounds=(best - apart, best + apart), method="bounded").x)
    amplitude = np.sqrt(2.0) * float(command.std())
    # Cramér-Rao bound of a frequency with unknown amplitude, phase and mean
    error = np.sqrt(24.0 * misfit(fitted) / t.size / t.size) / (amplitude * length)
    return fitted, float(error)


def _moment(see: _Seen, place: str) -> Iterator[Lack]:
    if np.ptp(see.angle[see.seen]) < LEAST_ANGLE:
        what = "the tilt does not vary in the window: the sweep of servo_duty is missing"
        yield Lack("window", see.first(see.seen), what, "record it", "move the window to it")
    running = see.seen & (see.duty > max(REST_DUTY, float(see.duty[see.rest].max())) + LEAST_DUTY)
    if running.any():
        what = f"duty is {see.duty[running].max():g} % in `window`: the moment is read with the motor off"
        yield Lack("window", see.first(running), what, "record it without thrust", "keep the duty of `rest`")
