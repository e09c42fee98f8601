"""Event location and time in model exchange, references over time, and values on their way to an FMU and back."""

from __future__ import annotations

import ctypes
import math
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cosim.base.errors import SimulationError
from cosim.blocks.component import EarlyEnd, Signal
from cosim.blocks.derivatives import slopes_at
from cosim.blocks.faults import samples_of, stream
from cosim.blocks.fmi_types import FMI1, FMI2, FMI3, Exchange, element_names, is_compatible, kinds_of
from cosim.blocks.model_exchange import MOST_EVENTS, ModelExchange2
from cosim.blocks.profile import Change, Profile, profile_function
from cosim.blocks.solvers import FAILURES, SolveIvp, SolverFailed, _failure, nominals
from cosim.blocks.sources import Recorded


class Fmu:
    """An FMU for model exchange whose events of time are listed; `log` keeps what is called, and when."""

    def __init__(self, events: Any = (), step_events: bool = False, ends_at: float = math.inf) -> None:
        self.events, self.step_events, self.ends_at = sorted(events), step_events, ends_at
        self.time, self.log = 0.0, list[tuple[str, float]]()
        self.more = 0

    def setTime(self, time: float) -> None:
        self.time = time

    def enterEventMode(self) -> None:
        self.log.append(("event", self.time))

    def enterContinuousTimeMode(self) -> None:
        self.log.append(("continuous", self.time))

    def completedIntegratorStep(self) -> tuple[bool, bool]:
        return self.step_events, self.time >= self.ends_at

    def newDiscreteStates(self) -> Any:
        self.events = [event for event in self.events if event > self.time + 1e-12]
        self.more -= 1
        due = self.events[0] if self.events else 0.0
        return self.more > 0, False, False, False, bool(self.events), due


class Solver:
    """Gets to its target, or to the first event of state before it; `spans` keeps from where to where."""

    def __init__(self, crossings: Any = ()) -> None:
        self.crossings, self.spans, self.resets = list(crossings), list[tuple[float, float]](), list[float]()

    def step(self, t: float, target: float) -> tuple[bool, None, float]:
        self.spans.append((t, target))
        found = [time for time in self.crossings if t < time <= target]
        return bool(found), None, min(found, default=target)

    def reset(self, time: float) -> None:
        self.resets.append(time)


def exchange(fmu: Fmu, solver: Solver, start: float = 0.0, completed: bool = False) -> ModelExchange2:
    ways = SimpleNamespace(needsCompletedIntegratorStep=completed)
    counts = {"numberOfContinuousStates": 1, "numberOfEventIndicators": 0}
    calls = ModelExchange2("m", SimpleNamespace(modelExchange=ways, derivatives=[], **counts))
    calls.fmu, calls.solver, calls._started, calls.time = fmu, solver, True, start
    fmu.time = start
    calls.update()
    fmu.log.clear()
    return calls


def stepped(calls: ModelExchange2, begin: float, h: float, count: int) -> None:
    for k in range(count):
        assert calls.stepping()(None, begin + k * h, h, 1) == 0
        assert calls.time == pytest.approx(begin + (k + 1) * h, abs=1e-8 * h)


@pytest.mark.parametrize("start", [0.0, 1e6])
def test_an_event_of_time_is_met_where_it_is_and_the_step_goes_on_behind_it(start: float) -> None:
    fmu, solver = Fmu([start + 0.25, start + 0.5, start + 0.75]), Solver()
    stepped(exchange(fmu, solver, start), start, 0.5, 2)
    edges = [start + t for t in (0.0, 0.25, 0.5, 0.75, 1.0)]
    assert solver.spans == [*pairwise(edges)]
    assert fmu.log == [(mode, t) for t in edges[1:4] for mode in ("event", "continuous")]
    assert solver.resets == edges[1:4]


def test_an_event_beyond_the_step_is_left_to_the_next() -> None:
    fmu, solver = Fmu([0.6]), Solver()
    calls = exchange(fmu, solver)
    calls.stepping()(None, 0.0, 0.5, 1)
    assert (solver.spans, fmu.log, calls.next_event) == ([(0.0, 0.5)], [], 0.6)


@pytest.mark.parametrize(("off", "joined"), [(-0.4e-9, True), (0.4e-9, True), (-1e-7, False), (1e-7, False)])
def test_an_event_within_a_billionth_of_a_step_of_its_end_is_at_its_end(off: float, joined: bool) -> None:
    fmu, solver = Fmu([1.0 + off]), Solver()
    exchange(fmu, solver).stepping()(None, 0.0, 1.0, 1)
    handled = [time for mode, time in fmu.log if mode == "event"]
    assert handled == ([max(1.0, 1.0 + off)] if joined else [1.0 + off] if off < 0 else [])
    assert len(solver.spans) == (2 if off == -1e-7 else 1)


def test_an_event_of_state_stops_the_solver() -> None:
    fmu, solver = Fmu(), Solver([0.125])
    exchange(fmu, solver).stepping()(None, 0.0, 0.5, 1)
    assert solver.spans == [(0.0, 0.5), (0.125, 0.5)]
    assert [time for mode, time in fmu.log if mode == "event"] == [0.125]


def test_an_fmu_ends_the_simulation_at_the_time_that_it_has_come_to() -> None:
    with pytest.raises(EarlyEnd) as ended:
        exchange(Fmu(ends_at=0.1), Solver([0.125]), completed=True).stepping()(None, 0.0, 0.5, 1)
    assert (ended.value.reached, ended.value.readable) == (0.125, True)


def test_a_step_of_a_few_spacings_of_doubles_is_refused() -> None:
    spacing = math.ulp(1e6)
    for count, refused in ((8, True), (9, False)):
        calls = exchange(Fmu(), Solver(), 1e6)
        if refused:
            with pytest.raises(SimulationError, match=r"is too short at this time: doubles are 1\.2e-10 s apart there"):
                calls.stepping()(None, 1e6, count * spacing, 1)
        else:
            calls.stepping()(None, 1e6, count * spacing, 1)
            assert calls.time == 1e6 + count * spacing


def test_nothing_is_integrated_over_less_than_the_solver_can() -> None:
    solver = Solver()
    calls = exchange(Fmu(), solver)
    for target, time in ((1e-12, 1e-12), (-1.0, 1e-12)):  # time does not go back
        assert calls._integrate(target, 1e-12) == (False, False)
        assert calls.time == time
    assert solver.spans == []
    calls._integrate(2.1e-12, 1e-12)
    assert solver.spans == [(1e-12, 2.1e-12)]


def test_a_thousand_events_within_a_millionth_of_a_step_are_chattering() -> None:
    def chatter(spacing: float) -> None:
        calls = exchange(Fmu(), Solver(spacing * k for k in range(1, 1500)))
        calls.stepping()(None, 0.0, 1.0, 1)

    chatter(1.01e-6 / (MOST_EVENTS - 1))
    with pytest.raises(SimulationError, match="it chatters: 1000 events within 1e-06 s"):
        chatter(0.99e-6 / (MOST_EVENTS - 1))


def test_discrete_states_are_updated_until_they_rest_a_thousand_times_at_most() -> None:
    for more, ends in ((MOST_EVENTS, True), (MOST_EVENTS + 1, False)):
        fmu = Fmu()
        calls = exchange(fmu, Solver())
        fmu.more = more
        if ends:
            calls.update()
        else:
            with pytest.raises(SimulationError, match="its discrete states still change after 1000 updates"):
                calls.update()


def test_a_derivative_that_is_no_number_goes_by_its_name() -> None:
    calls = exchange(Fmu(), Solver())
    calls.description.derivatives = [SimpleNamespace(variable=SimpleNamespace(name="der(x)"))]
    assert "the derivative der(x) is nan" in calls._explain(SolverFailed("", (0, math.nan)))
    calls.description.derivatives = []
    assert "the derivative number 1 is inf" in calls._explain(SolverFailed("", (0, math.inf)))
    assert calls._explain(SolverFailed("why")) == "why"


def test_solvers_say_why_they_fail_and_need_nominals_above_zero() -> None:
    assert _failure(None) == "CVODE failed"
    assert _failure((-2, "", "", "x")) == FAILURES[-2]
    assert _failure((-99, "", "", " a  b\n")) == "CVODE failed (code -99): a b"

    def given(where: Any, count: int) -> None:
        for k, value in enumerate((-2.0, 0.0, math.nan, 0.5)):
            where[k] = value

    cells = (ctypes.c_double * 4)()
    nominals(SimpleNamespace(getNominalsOfContinuousStates=given), cells, 4)
    assert list(cells) == [2.0, 1.0, 1.0, 0.5]


class Falling:
    """x' = −1 from 1; the indicator is x − 0.25."""

    x = t = 0.0

    def getContinuousStates(self, where: Any, count: int) -> None:
        where[0] = self.x

    def setContinuousStates(self, where: Any, count: int) -> None:
        self.x = where[0]

    def getDerivatives(self, where: Any, count: int) -> None:
        where[0] = -1.0

    def getNominalsOfContinuousStates(self, where: Any, count: int) -> None:
        where[0] = 1.0

    def getEventIndicators(self, where: Any, count: int) -> None:
        where[0] = self.x - 0.25

    def setTime(self, t: float) -> None:
        self.t = t


def test_solve_ivp_stops_just_behind_the_crossing() -> None:
    fmu = Falling()
    fmu.x = 1.0
    solver = SolveIvp(fmu, states=1, indicators=1, start=0.0, longest=0.1, tolerance=1e-8)
    time = 0.0
    while time < 0.5:
        event, _, time = solver.step(time, 0.5)
        assert not event
    assert fmu.x == pytest.approx(0.5)
    while not event:
        event, _, time = solver.step(time, 1.0)
    assert 0.75 <= time < 0.75 + 1e-9
    assert fmu.x <= 0.25  # the indicator is not positive any more
    assert solver.step(time, 1.0)[0] is False
    without = SolveIvp(Falling(), states=0, indicators=0, start=0.0, longest=0.5, tolerance=1e-8)
    assert without.step(0.0, 1e-4)[0] is False


# -- over time --------------------------------------------------------------------------------------


def test_a_reference_is_its_steps_and_ramps_at_any_time_alone_or_together() -> None:
    changes = [Change(at=1, to=2), Change(at=2, to=5, rate=1.5), Change(at=3, to=-1, rate=2), Change(at=9, to=0)]
    function = profile_function(Profile(start=-1, changes=changes), 10.0)
    expected = {
        0: -1, 0.999: -1, 1: 2, 1.5: 2, 2: 2, 2.5: 2.75, 3: 3.5, 3.5: 2.5, 5.25: -1,
        5: -0.5, 8: -1, 9: 0,
    }  # fmt: skip
    for time, value in expected.items():
        assert function(time) == pytest.approx(10.0 * value), time
    times = np.array(sorted(expected))
    assert function.over(times).tolist() == [function(t) for t in times]
    assert profile_function(Profile(start=4)).over(times).tolist() == [4.0] * times.size


def test_a_recording_holds_its_last_value_and_begins_with_its_first() -> None:
    function = Recorded([1.0, 2.0, 2.5], [10.0, 20.0, 25.0])
    times = [0.0, 1.0, 1.999, 2.0, 2.4, 2.5, 99.0]
    assert [function(t) for t in times] == [10, 10, 10, 20, 20, 25, 25]
    assert function.over(np.array(times)).tolist() == [10, 10, 10, 20, 20, 25, 25]


def test_noise_is_of_its_variance_and_bias_and_each_source_has_a_stream_of_its_own() -> None:
    samples = samples_of(stream(1, "a.u"), 0.25, 3.0, 100_000)
    assert samples.mean() == pytest.approx(3.0, abs=5 * 0.5 / math.sqrt(1e5))
    assert samples.var() == pytest.approx(0.25, rel=0.03)
    assert stream(1, "a.u").random() == stream(1, "a.u").random() != stream(1, "a.v").random()
    assert stream(1, "a.u").random() != stream(2, "a.u").random()


# -- values -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "value", "sound"),
    [
        ("Int8", 127, True), ("Int8", 128, False), ("Int8", -128, True), ("Int8", -129, False), ("Int8", 1.5, False),
        ("UInt16", 65535, True), ("UInt16", 65536, False), ("UInt16", -1, False), ("Int32", math.inf, False),
        ("Enumeration", 2**53, True), ("Enumeration", 2**53 + 2, False), ("Boolean", 1, True), ("Boolean", 2, False),
        ("Float32", 3.4028234663852886e38, True), ("Float32", 3.41e38, False), ("Float64", 1e308, True),
        ("Float32", -3.41e38, False), ("Float32", 3.4028236e38, False),
    ],
)  # fmt: skip
def test_a_type_of_fmi_holds_its_numbers_and_no_others(kind: str, value: float, sound: bool) -> None:
    if sound:
        assert FMI3[kind].encode(value) == value
    else:
        with pytest.raises(ValueError, match=r"outside|no whole number"):
            FMI3[kind].encode(value)


def test_values_stand_beside_the_row_where_no_double_holds_them() -> None:
    assert {name for name, kind in FMI3.items() if kind.beside} == {"Int64", "UInt64", "String", "Binary"}
    assert {name for name, kind in FMI2.items() if kind.beside} == {"String"}
    assert [ctypes.sizeof(FMI3[name].ctype) for name in ("Int8", "UInt16", "Int32", "UInt64")] == [1, 2, 4, 8]
    assert [kinds_of(version) for version in ("1.0", "2.0", "3.0")] == [FMI1, FMI2, FMI3]
    assert is_compatible("Int8", "Float64")
    assert not is_compatible("Float64", "Int8")
    assert not is_compatible("Clock", "Float64")


def test_elements_of_an_array_go_by_their_indices_from_one() -> None:
    array = SimpleNamespace(name="A", shape=(2, 2), valueReference=7)
    scalar = SimpleNamespace(name="b", shape=(), valueReference=8)
    assert element_names(array) == ["A[1,1]", "A[1,2]", "A[2,1]", "A[2,2]"]
    both = Exchange(FMI3["Int32"], [array, scalar])
    assert (both.count, list(both.vrs), len(both.arguments(True)), len(both.arguments(False))) == (5, [7, 8], 4, 3)
    with pytest.raises(ValueError, match=r"^A\[2,1\]: 2.5 is no whole number"):
        both.encode([1, 2, 2.5, 4, 5])


@pytest.mark.parametrize(
    ("here", "there", "found"),
    [
        (Signal("a", "deg"), Signal("b", "rad"), (math.pi / 180, 0.0)),
        (Signal("a", "m"), Signal("b", "kg"), None),
        (Signal("a", ""), Signal("b", "kg"), (1.0, 0.0)),
        (Signal("a", "x"), Signal("b", "x"), (1.0, 0.0)),
        (Signal("a", "C", (0, 0, 0, 0, 1, 0, 0, 0, 1.0, 273.15)), Signal("b", "K"), (1.0, 273.15)),
        (Signal("a", "K"), Signal("b", "F", (0, 0, 0, 0, 1, 0, 0, 0, 0.5, 255.0)), (2.0, -510.0)),
        (
            Signal("a", "C", (0, 0, 0, 0, 1, 0, 0, 0, 1.0, 273.15), relative=True),
            Signal("b", "K", relative=True),
            (1.0, 0.0),
        ),
    ],
)
def test_a_unit_is_converted_by_factor_and_offset(here: Signal, there: Signal, found: Any) -> None:
    assert here.conversion(there) == (None if found is None else pytest.approx(found))


# -- slopes -----------------------------------------------------------------------------------------


class Bent:
    """x' = x² u, y = x + 3 u: its slopes are 2 x u, x², 1 and 3."""

    name = "m"

    def __init__(self) -> None:
        self.asked: list[list[float]] = []

    def move(self, t: float, states: Any, inputs: Any) -> Any:
        return states

    def rates(self, states: Any, inputs: Any) -> Any:
        (x,), (u,) = states, inputs
        self.asked.append([float(x), float(u)])
        return np.array([x * x * u, x + 3.0 * u])

    def directional_slopes(self) -> Any:
        return np.array([[7.0, 7.0], [7.0, 7.0]])


@pytest.mark.parametrize(("x", "u"), [(0.5, -0.25), (4.0, 100.0)])
def test_slopes_are_central_differences_by_a_share_of_the_value_or_of_one(x: float, u: float) -> None:
    block: Any = Bent()
    slopes, here, after = slopes_at(block, 0.0, np.array([x]), np.array([u]), 1e-3, directional=False)
    assert slopes == pytest.approx(np.array([[2 * x * u, x * x], [1.0, 3.0]]), rel=1e-9)
    assert here == pytest.approx([x * x * u, x + 3.0 * u])
    assert after.tolist() == [x]
    size_x, size_u = 1e-3 * max(1.0, abs(x)), 1e-3 * max(1.0, abs(u))
    asked = [[x, u], [x + size_x, u], [x - size_x, u], [x, u + size_u], [x, u - size_u], [x, u]]
    assert np.array(block.asked) == pytest.approx(np.array(asked))
    assert slopes_at(block, 0.0, np.array([x]), np.array([u]), 1e-3, directional=True)[0].tolist() == [[7, 7], [7, 7]]


def test_slopes_that_are_not_finite_are_told() -> None:
    block: Any = Bent()
    with pytest.raises(SimulationError, match="its derivatives or outputs are not finite at these states"):
        slopes_at(block, 0.0, np.array([math.inf]), np.array([1.0]), 1e-3, directional=False)
    block.directional_slopes = lambda: np.array([[math.nan]])
    with pytest.raises(SimulationError, match="the slopes of its derivatives or outputs are not finite"):
        slopes_at(block, 0.0, np.array([1.0]), np.array([1.0]), 1e-3, directional=True)
