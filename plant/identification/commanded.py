"""Requirements of each test on its commands, checked in recordings and in planned phases."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from cosim.base.arrays import Array, Flags
from cosim.base.messages import Message, Template
from plant.bench import REST_DUTY, Bench
from plant.identification import messages
from plant.identification.misfit import residuals, sine_basis
from plant.identification.protocol import HoldTest, SineTest, StepTest, Test
from plant.identification.recordings import Recording
from plant.powertrain import servo_angle

MIN_DUTY_RANGE, MIN_ANGLE = 0.1, np.radians(5)  # [%, rad] least variation for a line and a moment
MIN_DUTY_STEP = 0.02  # [%] of the duty
SAME_DUTY = 0.01  # [%] difference of means within one command: two decimals, rounded
UPRIGHT = np.radians(2.5)  # cos deviates by 0.1 % from 1
MIN_ROWS = 10
ROWS_PER_PERIOD = 10  # rows in a period of a sine
MIN_ROWS_BEFORE = 3  # rows before a step
BEFORE = 0.3  # [s] before a step in a fit
UNSETTLED = 0.1  # share of a window that may contain the previous transient
JUMP = 3.0  # multiple of a ramp's step from row to row beyond which a jump is no ramp
MIN_SPEED_SHARE = 0.2  # share of a sine's fastest change from which a row belongs to the sine
SAME_FREQUENCY = 0.005  # difference of a frequency that is written with three digits, as a share
FREQUENCY_ERRORS = 4.0  # standard errors within which frequencies are equal
MAX_ROWS_PER_COMMAND = 10  # of a column that was resampled by straight lines
STRAIGHT = 0.1  # bend of a straight line relative to that between two lines, from rounding
SETTLED = 3.0  # lags and low passes until the thrust has settled to 5 % of a change


class Lack(NamedTuple):
    """A deficiency of a run: key of its test, row, and message."""

    key: str
    row: int
    message: Message


def windows_of(test: Test) -> dict[str, tuple[float, float]]:
    """Return the windows of a test by key; a sine test uses all rows after its lead."""
    windows = {"rest": test.rest, "window": test.window}
    if isinstance(test, HoldTest):
        windows["hold"] = test.hold
    if isinstance(test, SineTest):
        del windows["window"]
    return windows


def lacks(bench: Bench, name: str, test: Test, r: Recording, place: str, *, own: bool) -> Iterator[Lack]:
    """Yield all deficiencies of a run for its test; a run without a file is a planned one.

    Args:
        place: Place of the test in its protocol, for a cure.
        own: True if the thrust line in `bench` is simulated and gives the duty of zero thrust.
    """
    view = _TestRun(bench, name, test, r, place, own)
    missing = list(view.missing_windows())
    yield from missing
    if missing:
        return
    if name != "moment" and view.top <= view.idle:
        key = "duty" if isinstance(test, SineTest) else "phases"
        without_limit = messages.DUTY_OF_ONE if view.idle < 100.0 * view.top <= 100.0 else messages.NO_THRUST
        template = messages.NO_THRUST_ABOVE if own else without_limit
        yield view.lack(key, 0, template, value=view.top, limit=view.idle)
        return
    rest_duty = view.duty[view.rest].max()
    if (name != "moment" and rest_duty >= view.duty[~view.rest].max(initial=-np.inf)) or (
        rest_duty > max(REST_DUTY, view.duty.min()) + MIN_DUTY_RANGE
    ):
        yield view.lack("rest", view.first(view.rest), messages.NO_REST, value=rest_duty, rest=REST_DUTY)
        return
    checks = {"thrust_line": _ramp, "projection": _projection, "step": _step, "thrust_step": _step, "moment": _moment}
    yield from checks.get(name, _sine if isinstance(test, SineTest) else _steady_window)(view)


def moves(duty: Array) -> bool:
    """Return True if the duty changes over the run, or from its first to its last quarter."""
    quarter = max(1, duty.size // 4)
    return bool(np.ptp(duty) > MIN_DUTY_RANGE or abs(duty[:quarter].mean() - duty[-quarter:].mean()) > SAME_DUTY)


class _TestRun:
    """A run from the view of its test: commands, and rows at rest and in the window."""

    def __init__(self, bench: Bench, name: str, test: Test, r: Recording, place: str, own: bool) -> None:
        self.name, self.test, self.run, self.bench, self.place = name, test, r, bench, place
        self.duty, self.angle = r.duty, servo_angle(r.servo_duty, bench.servo_neutral, bench.servo_slope)
        self.rest = r.rows(test.rest)
        self.window: Flags = r.time >= test.lead + test.skip if isinstance(test, SineTest) else r.rows(test.window)
        self.top = float(self.duty.max())
        self.idle = -bench.thrust_offset / bench.thrust_slope if own else REST_DUTY
        self.settling = SETTLED * (bench.lag + test.low_pass)  # [s]

    def lack(self, key: str, row: int, template: Template, **fields: Any) -> Lack:
        """Return a deficiency with its cure."""
        cure = messages.RUN_CURES[template][self.run.path is not None].format(place=self.place, **fields)
        return Lack(key, row, template(**fields, cure=cure))

    def first(self, rows: Flags) -> int:
        """Return the index of the first True row."""
        return int(np.flatnonzero(rows)[0])

    def missing_windows(self) -> Iterator[Lack]:
        """Yield windows with too few rows of the run."""
        r, windows = self.run, windows_of(self.test)
        late = self.test.rest[1] < r.time[0] and r.time[-1] - r.time[0] >= max(end for _, end in windows.values())
        for key, (start, end) in windows.items():
            covered = r.time[0] <= start + 1.5 * r.step and end <= r.time[-1] + 1.5 * r.step
            if (count := int(r.rows((start, end)).sum())) >= MIN_ROWS and covered:
                continue
            window = {"window": key, "start": start, "end": end}
            if covered and r.step > (end - start) / MIN_ROWS:
                rows = {"step": r.step, "count": count, "least": MIN_ROWS}
                yield self.lack(key, 1, messages.TOO_FEW_ROWS_IN_WINDOW, **window, **rows)
            else:
                template = messages.CLOCK_WITHOUT_WINDOW if late else messages.NO_PHASE_IN_WINDOW
                yield self.lack(key, r.time.size - 1, template, first=r.time[0], last=r.time[-1], **window)

    def check_thrust(self, rows: Flags, key: str, where: str) -> Iterator[Lack]:
        """Yield a deficiency for rows without thrust."""
        idle = max(self.idle, float(self.duty[self.rest].max()))
        low = rows & (self.duty <= idle)
        if low.any():
            fields = {"value": self.duty[low].min(), "where": where, "limit": idle}
            yield self.lack(key, self.first(low), messages.DUTY_WITHOUT_THRUST, **fields)

    def check_upright(self, rows: Flags, key: str, where: str) -> Iterator[Lack]:
        """Yield a deficiency if some rows are not upright."""
        over = rows & (np.abs(self.angle) > UPRIGHT)
        if over.any():
            fields = {"value": np.degrees(np.abs(self.angle[over]).max()), "limit": np.degrees(UPRIGHT)}
            yield self.lack(key, self.first(over), messages.NOT_UPRIGHT, where=where, **fields)

    def check_steady(self, window: tuple[float, float], key: str, where: str) -> Iterator[Lack]:
        """Yield a deficiency for duty changes about a window."""
        rows = self.run.rows((window[0] - self.settling, window[1]))
        if moves(self.duty[rows]):
            fields = {"low": self.duty[rows].min(), "high": self.duty[rows].max(), "time": self.settling}
            yield self.lack(key, self.first(rows), messages.UNSTEADY_DUTY, where=where, **fields)

    def check_tilted_end(self, row: int) -> Iterator[Lack]:
        """Yield a deficiency for a tilt step ending upright."""
        last = abs(float(np.mean(self.angle[self.window][-MIN_ROWS_BEFORE:])))
        if last < UPRIGHT:
            yield self.lack("window", row, messages.UPRIGHT_END, angle=np.degrees(last))

    def check_sweep(self) -> Iterator[Lack]:
        """Yield a deficiency for constant tilt in the window."""
        if np.ptp(self.angle[self.window]) < MIN_ANGLE:
            yield self.lack("window", self.first(self.window), messages.NO_SWEEP)


def _ramp(view: _TestRun) -> Iterator[Lack]:
    (start, end), first = view.test.window, view.first(view.window)
    with_thrust = view.window & (view.duty > view.idle)
    span = {"start": start, "end": end}
    if np.ptp(view.duty[view.window]) < MIN_DUTY_RANGE:
        yield view.lack("window", first, messages.NO_RAMP, **span)
    elif not with_thrust.any() or np.ptp(view.duty[with_thrust]) < MIN_DUTY_RANGE:
        yield view.lack("window", first, messages.LOW_RAMP, least=MIN_DUTY_RANGE, limit=view.idle, **span)
    before = view.run.rows((start - view.settling, start))
    changes, ramp = (np.abs(np.diff(view.duty[rows])) for rows in (before, view.window))
    at = float(view.run.time[before][1 + int(np.argmax(changes))]) if changes.size else -np.inf
    jumps = changes.max(initial=0.0) > max(MIN_DUTY_STEP, JUMP * ramp.max(initial=0.0))
    if jumps and at + view.settling - start > UNSETTLED * (end - start):
        times = {"time": at, "start": start, "settling": view.settling, "begin": at + view.settling}
        yield view.lack("window", first, messages.JUMP_BEFORE_RAMP, **times)
    yield from view.check_upright(view.window, "window", "in `window`")


def _steady_window(view: _TestRun) -> Iterator[Lack]:
    idle = list(view.check_thrust(view.window, "window", "in `window`"))
    yield from idle or view.check_steady(view.test.window, "window", "in `window`")
    yield from view.check_upright(view.window, "window", "in `window`")


def _projection(view: _TestRun) -> Iterator[Lack]:
    assert isinstance(view.test, HoldTest)
    yield from view.check_sweep()
    hold = view.run.rows(view.test.hold)
    idle = list(view.check_thrust(view.window, "window", "in `window`"))
    idle += view.check_thrust(hold, "hold", "in `hold`")
    yield from idle
    yield from view.check_upright(
        view.run.rows((view.test.hold[0] - view.settling, view.test.hold[1])), "hold", "in `hold` or shortly before"
    )
    if idle:
        return
    yield from view.check_steady(view.test.window, "window", "in `window`")
    yield from (unsteady := list(view.check_steady(view.test.hold, "hold", "in `hold`")))
    duties = {"hold": float(view.duty[hold].mean()), "window": float(view.duty[view.window].mean())}
    if not unsteady and abs(duties["hold"] - duties["window"]) > SAME_DUTY:
        yield view.lack("hold", view.first(hold), messages.OTHER_DUTY_OF_HOLD, **duties)


def _step(view: _TestRun) -> Iterator[Lack]:
    assert isinstance(view.test, StepTest)
    r, at, (start, end) = view.run, view.test.at, view.test.window
    thrust = view.name == "thrust_step"
    signals = [("duty", view.duty, MIN_DUTY_STEP), ("servo_duty", view.angle, MIN_ANGLE)]
    (command, own, least), (other_command, other, _) = signals if thrust else signals[::-1]
    row = min(int(np.searchsorted(r.time, at)), r.time.size - 1)
    near = (r.time >= at - 2.5 * r.step) & (r.time <= at + 2.5 * r.step)
    step = np.abs(np.diff(own[near])).max(initial=0.0)
    if step < least:
        fields = {"command": command, "time": at}
        if 10.0 * step > least:
            size, need = (f"{v:.3g} %" if thrust else f"{np.degrees(v):.3g}°" for v in (step, least))
            yield view.lack("at", row, messages.SMALL_STEP, size=size, least=need, **fields)
        else:  # slower motion is no step
            yield view.lack("at", row, messages.NO_STEP, steps=_step_times(own, r.time, least), **fields)
        return
    if not start - 0.5 * r.step <= at <= end:
        yield view.lack("window", row, messages.STEP_OUTSIDE_WINDOW, start=start, end=end, time=at)
        return
    after, before = (int(rows.sum()) for rows in (r.rows((at, end)), r.time < at - 0.5 * r.step))
    if after < MIN_ROWS or before < MIN_ROWS_BEFORE:
        rows = {"after": after, "before": int((r.time < at).sum()), "time": at}
        limits = {"least_after": MIN_ROWS, "least_before": MIN_ROWS_BEFORE}
        yield view.lack("window", row, messages.TOO_FEW_ROWS_ABOUT_STEP, **rows, **limits)
        return
    yield from [] if thrust else view.check_tilted_end(row)
    yield from view.check_thrust(r.rows((at, end)), "window", "after the step")
    begin = max(float(r.time[0]), at - BEFORE - view.settling)
    about = other[r.rows((begin, end))]
    if np.ptp(about) > MIN_ANGLE if thrust else moves(about):
        names = {"other": other_command, "command": command, "start": begin, "end": end}
        yield view.lack("window", row, messages.TWO_STEPS, **names)


def _step_times(signal: Array, time: Array, least: float) -> str:
    """Return a clause with the times of steps of at least `least` in a command."""
    steps = time[1:][np.abs(np.diff(signal)) >= least]
    return f"there is one at {', '.join(f'{t:g}' for t in steps[:3])} s" if 0 < steps.size < 20 else "there is none"


def _sine(view: _TestRun) -> Iterator[Lack]:
    assert isinstance(view.test, SineTest)
    lead, r = view.test.lead, view.run
    if view.window.sum() < MIN_ROWS or np.ptp(view.angle[view.window]) < np.radians(1):
        yield view.lack("amplitude", 0, messages.NO_SINE, time=lead)
        return
    idle = list(view.check_thrust(view.window, "duty", "under the sine"))
    yield from idle
    duty = view.duty[view.window]
    if not idle and moves(duty):
        row = view.first(view.window)
        yield view.lack("duty", row, messages.SINE_AT_SEVERAL_DUTIES, low=duty.min(), high=duty.max())
    w = frequency_of(r, view.test)
    place = view.test.frequencies.index(w)
    skips = [*view.test.thesis_skip, *(0.0 for _ in view.test.frequencies)]
    needed = lead + max(view.test.skip, skips[place] * 2.0 * np.pi / w) + 2.0 * np.pi / w
    if r.time[-1] < needed - 1.5 * r.step:
        times = {"time": r.time[-1], "needed": needed}
        yield view.lack("periods", r.time.size - 1, messages.SHORT_SINE, frequency=w, **times)
    if r.path is None:
        return
    if rows := _rows_per_command(r.servo_duty[view.window]):
        fields = {"rows": rows, "time": 0.5 * (rows - 1) * r.step}
        yield view.lack("frequencies", view.first(view.window), messages.INTERPOLATED_COMMAND, **fields)
    yield from _other_frequency(view, w)
    if w * r.step > 2.0 * np.pi / ROWS_PER_PERIOD * (1.0 + 1e-3):
        fields = {"step": r.step, "least": ROWS_PER_PERIOD, "frequency": w, "limit": 2.0 * np.pi / w / ROWS_PER_PERIOD}
        yield view.lack("frequencies", 1, messages.TOO_FEW_ROWS_IN_PERIOD, **fields)


def _rows_per_command(command: Array) -> int:
    """Return the rows from command to command of a column with straight lines between them; 0 for other columns."""
    bends = np.diff(command, 2)
    for rows in range(2, MAX_ROWS_PER_COMMAND + 1):
        sizes = np.array([np.sqrt(np.mean(bends[k::rows] ** 2)) for k in range(rows)]) if bends.size >= rows else None
        if sizes is not None and np.sort(sizes)[-2] < STRAIGHT * sizes.max():
            return rows
    return 0


def frequency_of(r: Recording, test: SineTest) -> float:
    """Return the protocol's frequency [rad/s] nearest a run's command."""
    rows = r.time >= test.lead
    t, command = r.time[rows] - test.lead, r.servo_duty[rows] - r.servo_duty[rows].mean()
    return min(test.frequencies, key=lambda w: _squared_misfit(w, t, command))


def _squared_misfit(w: float, t: Array, values: Array) -> float:
    """Return the sum of squared residuals of a sine with a constant, fitted at the frequency w."""
    rest = residuals(values, sine_basis(w * t))
    return float(rest @ rest)


def _other_frequency(view: _TestRun, w: float) -> Iterator[Lack]:
    """Yield a deficiency for a frequency not in the protocol."""
    assert isinstance(view.test, SineTest)
    after = np.flatnonzero(view.run.time >= view.test.lead - 0.5 * view.run.step)
    changes = np.abs(np.diff(view.run.servo_duty[after]))
    moving = np.flatnonzero(changes > MIN_SPEED_SHARE * np.quantile(changes[changes > 0.0], 0.9))
    rows = after[moving[0] : moving[-1] + 1]  # without rests before and after the sine
    time, command = view.run.time[rows], view.run.servo_duty[rows]
    if rows.size < MIN_ROWS or w * (time[-1] - time[0]) < np.pi:
        return
    fitted, error = fit_frequency(time, command, w)
    if abs(fitted - w) > SAME_FREQUENCY * w + FREQUENCY_ERRORS * error:
        yield view.lack("frequencies", int(rows[0]), messages.OTHER_FREQUENCY, fitted=fitted, frequency=w)


def fit_frequency(time: Array, command: Array, near: float) -> tuple[float, float]:
    """Return frequency and standard error [rad/s] of a sine plus constant, between half and twice `near`."""
    from scipy.optimize import minimize_scalar

    t = time - time.mean()
    length = float(t[-1] - t[0])
    apart = 0.5 / length  # a tenth of the main lobe of the sine, 2·2π / length, or less
    grid = np.arange(0.5 * near, 2.0 * near + apart, apart)
    best = float(grid[np.argmin([_squared_misfit(w, t, command) for w in grid])])
    bounds = (best - apart, best + apart)
    fitted = float(minimize_scalar(_squared_misfit, bounds=bounds, args=(t, command), method="bounded").x)
    amplitude = np.sqrt(2.0) * float(command.std())
    # Cramér-Rao bound of a frequency with unknown amplitude, phase and mean
    error = np.sqrt(24.0 * _squared_misfit(fitted, t, command) / t.size / t.size) / (amplitude * length)
    return fitted, float(error)


def _moment(view: _TestRun) -> Iterator[Lack]:
    yield from view.check_sweep()
    running = view.window & (view.duty > max(REST_DUTY, float(view.duty[view.rest].max())) + MIN_DUTY_RANGE)
    if running.any():
        yield view.lack("window", view.first(running), messages.MOTOR_ON, value=view.duty[running].max())
