"""Where a replay starts: parabolas through what was measured, against polynomials and bodies whose state is known."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cosim.base.arrays import Array
from cosim.base.errors import InputError, SimulationError
from cosim.blocks.component import Signal
from cosim.fmi.state import MEMORY, STATE
from cosim.logs.log import Log
from cosim.model.planar import PlanarFrame
from cosim.residuals import starts
from cosim.residuals.drive import Drive, DriveSteps, as_columns
from cosim.residuals.starts import (
    StartParameter,
    first_start,
    noise_levels,
    readable,
    remaining_memory,
    sigma_of,
    window_start,
)

ALL = (-math.inf, math.inf)


def log_of(time: Array, step: float = 0.02, **outputs: Array) -> Log:
    units = dict.fromkeys(outputs, "rad")
    return Log(Path("a.csv"), time, {}, outputs, units, step, {}, {})


def seconds(duration: float, step: float = 0.02) -> Array:
    return step * np.arange(round(duration / step) + 1)


def parameter(name: str = "y_start", gain: float = 1.0, low: float = -math.inf, high: float = math.inf) -> Any:
    return StartParameter(name, gain, low, high, (0.1, 0.2))


# -- which parameter starts an output ---------------------------------------------------------------


class Trial:
    """A drive that tells what an output is at the start, by a function of one start parameter."""

    has_readable_state = False

    def __init__(self, shown: Any, name: str = "y_start", output: str = "y", **variable: Any) -> None:
        start = {"start": variable.get("start"), "min": variable.get("min"), "max": variable.get("max")}
        kind = {"type": variable.get("type", "Real"), "causality": variable.get("causality", "parameter")}
        self.description = SimpleNamespace(modelVariables=[SimpleNamespace(name=name, **start, **kind)])
        self.outputs, self.shown, self.name, self.tried = (output,), shown, name, list[float]()

    def initial(self, start: Mapping[str, float], row: int) -> dict[str, float]:
        assert row == 0
        self.tried.append(start[self.name])
        return {self.outputs[0]: self.shown(start[self.name])}


def found(drive: Any) -> dict[str, StartParameter]:
    return starts.start_parameters(drive)


def test_an_output_starts_where_a_parameter_of_its_name_says() -> None:
    (one,) = found(Trial(lambda v: 2.0 * v, start="3")).values()
    assert (one.name, one.gain, one.value(5.0)) == ("y_start", pytest.approx(2.0), pytest.approx(2.5))
    assert found(Trial(lambda v: v, "tilt_start", "tilt_actual")).keys() == {"tilt_actual"}
    assert found(Trial(lambda v: v, "z_start")) == {}
    assert found(Trial(lambda v: v, type="Integer")) == {}
    assert found(Trial(lambda v: v, causality="input")) == {}


def test_an_output_that_does_not_follow_in_proportion_starts_elsewhere() -> None:
    assert found(Trial(lambda v: v + 1e-3)) == {}
    assert found(Trial(lambda v: 4.0)) == {}
    assert found(Trial(lambda v: v * v)) == {}
    assert found(Trial(lambda v: 1e-10 * v)) == {}
    assert found(Trial(lambda v: 1e-8 * v)).keys() == {"y"}  # small, and in proportion
    assert found(Trial(lambda v: v + 1e-8)).keys() == {"y"}  # rounding


def test_values_that_are_tried_lie_within_the_bounds() -> None:
    for low, high in ((-1.0, 0.05), (0.0, 0.25), (-0.15, 0.1)):
        drive = Trial(lambda v: v, start="0", min=str(low), max=str(high))
        (one,) = found(drive).values()
        assert len(set(drive.tried)) == 2
        assert all(low <= v <= high for v in drive.tried)
        assert (one.low, one.high) == (low, high)
        assert (one.value(9.0), one.value(-9.0)) == (high, low)
    assert found(Trial(lambda v: v, start="0", min="0", max="0.15")) == {}  # room for one alone


def test_an_fmu_that_refuses_a_start_value_is_started_as_it_is() -> None:
    def refused(_: float) -> float:
        raise SimulationError("plant", 0.0, "no")

    assert found(Trial(refused)) == {}


def test_what_start_values_set_is_not_kept_of_the_state() -> None:
    own = {STATE: [1.0, 2.0, 3.0], MEMORY: [4.0]}
    placed = StartParameter("b_start", 1.0, *ALL, (0.1, 0.2), places=(1,))
    other = StartParameter("c_start", 1.0, *ALL, (0.1, 0.2), places=(2,))
    parameters = {"b": placed, "c": other}
    assert remaining_memory(own, parameters, {"b_start": 9.0}) == {(STATE, 0): 1.0, (STATE, 2): 3.0, (MEMORY, 0): 4.0}
    assert len(remaining_memory(own, parameters, {})) == 4
    assert readable(parameters)
    assert not readable({"b": parameter()})


# -- the parabola -----------------------------------------------------------------------------------

VALUE, SLOPE, BEND = 0.3, -0.7, 1.9


def parabola(error: Array, log: Log, at: int, rows: Any, sigma: float = 1e-3, rate: Array | None = None) -> Any:
    errors = [(error[rows], sigma, False)] + ([] if rate is None else [(rate[rows], sigma, True)])
    return starts._parabola(log, errors, at, np.asarray(rows))


def test_a_parabola_is_met_exactly_in_value_and_slope() -> None:
    time = seconds(4.0)
    log = log_of(time, y=time)
    tau = time - time[100]
    error = VALUE + SLOPE * tau + 0.5 * BEND * tau**2
    for rows in (range(75, 101), range(95, 101)):
        assert parabola(error, log, 100, [*rows]) == (pytest.approx(VALUE), pytest.approx(SLOPE))
    rate = SLOPE + BEND * tau
    assert parabola(error, log, 100, [98, 99, 100], rate=rate) == (pytest.approx(VALUE), pytest.approx(SLOPE))
    assert parabola(rate, log, 100, [*range(75, 101)], rate=np.full(time.size, BEND)) == (
        pytest.approx(SLOPE), pytest.approx(BEND),
    )  # fmt: skip


def test_few_samples_make_a_line_and_fewer_a_value() -> None:
    time = seconds(4.0)
    log, tau = log_of(time, y=time), time - time[100]
    line = VALUE + SLOPE * tau
    bent = line + np.where(np.arange(time.size) == 98, 0.01, 0.0)  # with five a parabola would take part of it up
    for rows in ([96, 97, 98, 99, 100], [98, 99, 100]):
        fit = np.polyfit(tau[rows], bent[rows], 1)
        assert parabola(bent, log, 100, rows, sigma=0.1) == (pytest.approx(fit[1]), pytest.approx(fit[0]))
    assert parabola(line, log, 100, [99, 100]) == (pytest.approx(line[[99, 100]].mean()), None)
    assert parabola(line, log, 100, np.arange(0)) == (None, None)


def test_what_does_not_fit_a_parabola_is_carried_less_far() -> None:
    time = seconds(4.0)
    log, tau = log_of(time, y=time), time - time[100]
    smooth = VALUE + SLOPE * tau
    kinked = smooth + 20.0 * np.maximum(0.0, -0.2 - tau)  # more than 0.2 s ago it was something else
    value, slope = parabola(kinked, log, 100, [*range(101)])
    assert (value, slope) == (pytest.approx(VALUE), pytest.approx(SLOPE))
    # and what is within its noise is used to the end of the half second, and no longer
    noise = 1e-3 * np.random.default_rng(1).standard_normal(time.size)
    older = smooth + noise + np.where(tau < -0.51, 5.0, 0.0)
    rows = np.arange(75, 101)
    fit = np.polyfit(tau[rows], older[rows], 2)
    assert parabola(older, log, 100, [*range(101)]) == (pytest.approx(fit[2]), pytest.approx(fit[1]))


def test_ahead_of_the_first_row_a_whole_second_is_used() -> None:
    time = seconds(4.0)
    log = log_of(time, y=time)
    noise = 1e-3 * np.random.default_rng(2).standard_normal(time.size)
    error = VALUE + SLOPE * time + noise + np.where(time > 1.01, 5.0, 0.0)
    fit = np.polyfit(time[:51], error[:51], 2)
    assert parabola(error, log, 0, [*range(201)]) == (pytest.approx(fit[2]), pytest.approx(fit[1]))


def test_channels_weigh_by_their_noise() -> None:
    time = seconds(4.0)
    log, rows = log_of(time, y=time), np.arange(75, 101)
    one, other = np.ones(rows.size), 3.0 * np.ones(rows.size)
    value, _ = starts._parabola(log, [(one, 0.1, False), (other, 1000.0, False)], 100, rows)
    assert value == pytest.approx(1.0, abs=1e-6)


def test_a_slow_sensor_is_looked_for_further_away_but_not_beyond_two_seconds() -> None:
    time = seconds(8.0)
    log = log_of(time, y=time)
    slow = np.arange(0, 301, 25)  # each half second
    assert slow[starts._rows_near(log, slow, 300, 0.5)].tolist() == [225, 250, 275, 300]
    slower = np.arange(0, 301, 40)  # 1.6 s, 0.8 s … before 280
    assert slower[starts._rows_near(log, slower, 300, 0.5)].tolist() == [200, 240, 280]
    assert starts._rows_near(log, np.arange(0, 150), 300, 0.5).size == 0
    fast = np.arange(0, 301)
    assert starts._rows_near(log, fast, 300, 0.5).size == 26


def test_the_noise_of_a_channel_without_any_is_its_rounding() -> None:
    time = seconds(10.0)
    assert sigma_of(np.full(time.size, 5.0)) == pytest.approx(5e-6)
    assert sigma_of(np.zeros(time.size)) == pytest.approx(1e-12)
    assert sigma_of(np.where(time < 0.05, 5.0, np.nan)) == pytest.approx(5e-6)  # too few to tell
    noisy = np.sin(time) + 0.01 * np.random.default_rng(3).standard_normal(time.size)
    assert sigma_of(noisy) == pytest.approx(0.01, rel=0.3)
    assert sigma_of(noisy, np.sin(time)) == pytest.approx(0.01, rel=0.2)
    assert noise_levels(log_of(time, y=noisy)).keys() == {"y"}


# -- a body whose state is known --------------------------------------------------------------------

PLACES = ("x", "vx")


class Body:
    """A drive of a body that keeps its velocity, whatever the log says: what the model lacks is an acceleration."""

    outputs, frame, given = PLACES, None, dict[str, float]()

    def __init__(self, log: Log) -> None:
        self.log, self.runs = log, 0

    def run(self, first: int, last: int, start: Mapping[str, float]) -> Array:
        self.runs += 1
        t = self.log.time[first : last + 1] - self.log.time[first]
        speed = np.full(t.size, start.get("vx_start", 0.0))
        return np.column_stack([start.get("x_start", 0.0) + speed * t, speed])


BODY = {name: parameter(f"{name}_start") for name in PLACES}


def measured(acceleration: float, noise: float = 1e-4, **only: bool) -> Log:
    time, rng = seconds(6.0), np.random.default_rng(4)
    x = VALUE + SLOPE * time + 0.5 * acceleration * time**2 + noise * rng.standard_normal(time.size)
    v = SLOPE + acceleration * time + 10 * noise * rng.standard_normal(time.size)
    return log_of(time, **{n: y for n, y in (("x", x), ("vx", v)) if only.get(n, True)})


@pytest.mark.parametrize("only", [{}, {"vx": False}])
@pytest.mark.parametrize("acceleration", [0.0, 0.4])
def test_the_first_start_is_that_of_the_body_also_where_its_speed_is_not_measured(
    acceleration: float, only: dict[str, bool]
) -> None:
    log = measured(acceleration, **only)
    drive: Any = Body(log)
    start = first_start(drive, BODY)
    # 50 rows of 0.1 mm: of a parabola's end 3·σ/√50, of its slope 19·σ/(1 s·√50)
    assert start["x_start"] == pytest.approx(VALUE, abs=4 * 3e-4 / math.sqrt(50))
    assert start["vx_start"] == pytest.approx(SLOPE, abs=4 * 19e-4 / math.sqrt(50))


def test_a_start_value_that_was_given_is_kept() -> None:
    drive: Any = Body(measured(0.0))
    drive.given = {"x_start": 7.0}
    assert first_start(drive, BODY)["x_start"] == 7.0


def test_nothing_is_tried_where_nothing_is_measured() -> None:
    time = seconds(6.0)
    drive: Any = Body(log_of(time, other=time))
    assert first_start(drive, BODY) == {}
    assert drive.runs == 0


@pytest.mark.parametrize("acceleration", [0.0, 0.4])
def test_a_window_starts_at_the_end_of_a_parabola_through_the_half_second_before(acceleration: float) -> None:
    log = measured(acceleration)
    drive: Any = Body(log)
    k, since = 200, 150
    carrier = as_columns(
        np.vstack([np.full((since, 2), np.nan), drive.run(since, k, {"x_start": 1.0, "vx_start": 0.0})]), PLACES
    )
    start = window_start(drive, BODY, noise_levels(log), carrier, since, k)
    t = log.time[k]
    assert start["x_start"] == pytest.approx(VALUE + SLOPE * t + 0.5 * acceleration * t**2, abs=4e-4)
    assert start["vx_start"] == pytest.approx(SLOPE + acceleration * t, abs=5e-3)


def test_of_an_fmu_whose_state_can_be_kept_only_what_is_measured_is_set() -> None:
    log = measured(0.0)
    drive: Any = Body(log)
    drive.outputs = (*PLACES, "hidden")
    known = {**BODY, "hidden": StartParameter("hidden_start", 1.0, *ALL, (0.1, 0.2), places=(0,))}
    carrier = as_columns(np.column_stack([drive.run(0, 200, {}), np.ones(201)]), drive.outputs)
    assert window_start(drive, known, noise_levels(log), carrier, 0, 200).keys() == {"x_start", "vx_start"}
    plain = known | {"hidden": parameter("hidden_start")}
    assert window_start(drive, plain, noise_levels(log), carrier, 0, 200)["hidden_start"] == 1.0


def test_velocities_of_the_world_are_turned_into_the_axes_of_the_body() -> None:
    """A body that sees its place and heading: forward and rightward velocity follow from both."""
    frame = PlanarFrame("X", "Y", "heading", "forward", "right")
    time = seconds(2.0)
    heading, forward, right = 0.6, 0.5, -0.2
    world = (
        forward * math.cos(heading) + right * math.sin(heading),
        forward * math.sin(heading) - right * math.cos(heading),
    )
    zero = np.zeros(time.size)
    log = log_of(time, X=world[0] * time, Y=world[1] * time, heading=zero + heading)
    carrier = {"X": zero, "Y": zero, "heading": zero, "forward": zero, "right": zero}
    state = dict.fromkeys(carrier, 0.0)
    sigma = dict.fromkeys(log.outputs, 1e-4)
    corrected = starts._corrections(SimpleNamespace(log=log, frame=frame), carrier, sigma, state, 50, np.arange(51))
    assert corrected.keys() == {"X", "Y", "heading", "forward", "right"}
    assert (corrected["forward"], corrected["right"]) == (pytest.approx(forward), pytest.approx(right))
    assert corrected["X"] == pytest.approx(world[0] * time[50])
    assert corrected["heading"] == pytest.approx(heading)
    seen = SimpleNamespace(log=log_of(time, **log.outputs, forward=zero), frame=frame)  # which is measured itself
    corrected = starts._corrections(seen, carrier, sigma | {"forward": 1e-4}, state, 50, np.arange(51))
    assert corrected["forward"] == pytest.approx(0.0)


# -- steps between rows -----------------------------------------------------------------------------


def drive_of(time: Array, ramps: tuple[bool, ...] = (False,), any_step: bool = True, step: float = 0.1) -> Any:
    drive: Any = object.__new__(Drive)
    drive.log, drive.variable_step, drive._ramps = log_of(time, step, y=time), any_step, np.array(ramps)
    drive._table = np.column_stack([10.0 * time, -time])
    drive._commands = drive._table.tolist()
    return drive


def test_steps_are_as_logged_and_over_a_hole_about_as_long_as_the_others() -> None:
    time = np.array([0.0, 0.1, 0.26, 0.36, 0.76, 0.81])
    steps = drive_of(time)._steps(0, 5)
    assert steps.times == pytest.approx([0.0, 0.1, 0.18, 0.26, 0.36, 0.46, 0.56, 0.66, 0.76])
    assert steps.lengths == pytest.approx([0.1, 0.08, 0.08, 0.1, 0.1, 0.1, 0.1, 0.1, 0.05])
    assert steps.rows == [0, 1, 1, 2, 3, 3, 3, 3, 4]
    assert steps.reads == [True, False, True, True, False, False, False, True, True]
    assert steps.reached == pytest.approx(time)
    assert drive_of(time)._steps(2, 4).rows == [2, 3, 3, 3, 3]
    assert drive_of(time)._steps(3, 3) == DriveSteps([], [], [], [], [0.36])


def test_the_rounding_of_printed_times_is_no_jitter() -> None:
    time = 0.1 * np.arange(6) + np.array([0.0, 4e-8, -4e-8, 0.0, 4e-6, 0.0])
    held = drive_of(time)._steps(0, 5).lengths
    assert held[:3] == [0.1, 0.1, 0.1]
    assert held[3] == pytest.approx(0.100004, abs=1e-9)


def test_an_fmu_that_takes_equal_steps_alone_takes_those_of_the_log() -> None:
    time = np.array([0.0, 0.1, 0.21, 0.3, 0.6])
    drive = drive_of(time, any_step=False)
    steps = drive._steps(0, 4)
    assert steps.times == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    assert (steps.lengths, steps.rows) == ([0.1] * 6, [0, 1, 1, 3, 3, 3])  # the command that acts when a step begins
    assert steps.reads == [True] * 6
    assert drive._puts(steps, 0) == [None, *([10.0 * time[k], -time[k]] if k else None for k in (1, 0, 3, 0, 0))]


def test_an_input_that_is_interpolated_is_the_mean_of_each_step_and_any_other_is_held() -> None:
    drive = drive_of(np.array([0.0, 0.1, 0.3]), (True, False))
    steps = drive._steps(0, 2)
    assert len(steps.times) == 24
    commands = np.array(drive._puts(steps, 0))
    middle = np.array(steps.times) + 0.5 * np.array(steps.lengths)
    np.testing.assert_allclose(commands[:, 0], 10.0 * middle)
    np.testing.assert_allclose(commands[:, 1], -drive.log.time[steps.rows])
    last = DriveSteps([0.3], [0.1], [2], [True], [])
    assert drive._puts(last, 2) == [[pytest.approx(3.0), pytest.approx(-0.3)]]  # of the last row: held


def test_rows_between_two_steps_are_interpolated_and_those_not_reached_are_left_out() -> None:
    drive = drive_of(np.array([0.0, 0.1, 0.21, 0.3, 0.6]))
    straight = np.array([[0.0], [1.0], [2.0], [3.0]])
    table = drive._at_rows(straight, [0.0, 0.1, 0.2, 0.3], 0, 4)
    assert table[:, 0] == pytest.approx([0.0, 1.0, 2.1, 3.0])
    rows = drive._at_rows(straight[:2], [0.0, 0.1], 0, 4)
    assert rows[:, 0].tolist() == [0.0, 1.0]
    assert drive._at_rows(straight[:0], [], 0, 4).shape[0] == 0


def test_an_fmu_is_asked_for_what_it_has(tmp_path: Path) -> None:
    drive = drive_of(seconds(1.0))
    drive.variables, drive.fmu = {"mass", "arm"}, tmp_path / "a.fmu"
    drive._check_start({"mass": 1.0})
    with pytest.raises(Exception, match='has no parameter "mas"; did you mean "mass"') as error:
        drive._check_start({"mas": 1.0, "arm": 2.0})
    assert len(error.value.faults) == 1  # type: ignore[attr-defined]


def test_what_an_fmu_is_shown_to_give_is_what_follows_its_inputs_in_the_row() -> None:
    """The outputs at the start are not the inputs that stand before them."""
    drive: Any = object.__new__(Drive)
    row = (ctypes.c_double * 3)(1.0, 2.0, 3.0)
    silent = SimpleNamespace(inputs=[1, 2], start=lambda: None, get=lambda: None)
    drive.block, drive.outputs, drive._row, drive.log = silent, ("y",), row, log_of(seconds(1.0))
    begun = list[tuple[Any, ...]]()
    drive._begin = lambda *arguments: begun.append(arguments)
    assert drive.initial({"a": 1.0}, 10) == {"y": 3.0}
    assert begun == [({"a": 1.0}, 10, 1.0)]


def test_signals_of_the_log_are_those_of_the_fmu_in_its_units() -> None:
    drive = drive_of(seconds(1.0))
    drive.fmu = Path("a.fmu")
    drive.block = SimpleNamespace(inputs=[], outputs=[Signal("y", "rad")])
    drive._check_signals()
    for outputs, told in (
        ([Signal("yaw", "rad")], 'has no output "y", which a.csv holds (its outputs: yaw)'),
        ([], 'has no output "y", which a.csv holds (its outputs: none)'),
        ([Signal("y", "deg")], "y is in deg here and in rad in the log as it was read; read the log for this FMU"),
    ):
        drive.block.outputs = outputs
        with pytest.raises(InputError) as error:
            drive._check_signals()
        assert [str(fault) for fault in error.value.faults] == [f"a.fmu: {told}"]
