"""What an FMU answers and says: statuses, ends that it asks for, messages, and how much it is asked to log."""

from __future__ import annotations

import ctypes
from collections import deque
from types import SimpleNamespace
from typing import Any

import pytest

from cosim.base.errors import SimulationError, Terminated
from cosim.blocks.component import EarlyEnd
from cosim.blocks.fmi import CoSimulation1, CoSimulation2, CoSimulation3
from cosim.blocks.instance import LONGEST_MESSAGE, Instance

OK, WARNING, DISCARD, ERROR, FATAL, PENDING = range(6)


def instance(ended: float | None = None, logging: bool = False) -> Any:
    made: Any = object.__new__(Instance)
    made.name, made.time, made.fmu, made.log = "m", 1.5, object(), deque(maxlen=3)
    made._words = ""
    made.step_name, made._logging, made._stop = "fmi2DoStep", logging, None
    made.calls = SimpleNamespace(end_time=lambda t: ended)
    return made


@pytest.mark.parametrize(
    ("status", "word"),
    [(DISCARD, "Discard"), (ERROR, "Error"), (FATAL, "Fatal"), (PENDING, "Pending"), (17, "17"), (-1, "-1")],
)
def test_a_status_that_is_no_warning_fails_with_its_name_and_the_last_words(status: int, word: str) -> None:
    made = instance()
    made._words = "too\n  hot"
    with pytest.raises(SimulationError, match=rf"^m at t = 1.5 s: fmi2GetReal returned {word}: too hot$"):
        made.judge("fmi2GetReal", status)
    assert (made.fmu is None) is (status == FATAL)  # not to be touched again


def test_a_warning_is_remembered_and_the_run_goes_on() -> None:
    made = instance()
    made.judge("fmi2DoStep", WARNING)
    assert list(made.log) == ["fmi2DoStep returned Warning"]


def test_a_step_that_is_discarded_to_end_the_run_is_no_failure() -> None:
    made = instance(ended=1.75)
    with pytest.raises(EarlyEnd, match=r"returned Discard: the FMU ended the simulation early$") as end:
        made.judge("fmi2DoStep", DISCARD)
    assert (end.value.reached, end.value.readable, end.value.component) == (1.75, True, "m")
    for function, status in (("fmi2GetReal", DISCARD), ("fmi2DoStep", ERROR)):
        with pytest.raises(SimulationError) as failed:
            made.judge(function, status)
        assert not isinstance(failed.value, EarlyEnd)
    with pytest.raises(SimulationError) as failed:
        instance(ended=None).judge("fmi2DoStep", DISCARD)
    assert not isinstance(failed.value, EarlyEnd)


def test_messages_below_a_warning_are_kept_where_debugging_is_asked_for() -> None:
    for logging, kept in ((False, ["hot"]), (True, ["cold", "hot"])):
        made = instance(logging=logging)
        made.listen(OK, b"cold")
        made.listen(WARNING, b"hot")
        assert list(made.log) == kept
    made.listen(ERROR, None)
    assert made.log[-1] == ""
    made.remember("x" * (LONGEST_MESSAGE + 1))
    assert len(made.log[-1]) == LONGEST_MESSAGE


def test_what_stops_the_process_while_an_fmu_speaks_is_kept_until_the_call_is_over() -> None:
    made = instance()
    made.raise_stop()
    made.remember = lambda text: (_ for _ in ()).throw(Terminated())
    made.listen(WARNING, b"hot")
    with pytest.raises(Terminated):
        made.raise_stop()
    made.raise_stop()


def ended_by(terminated: Any, last: Any) -> float | None:
    def answer(value: Any) -> Any:
        if isinstance(value, Exception):
            raise value
        return value

    calls = CoSimulation2("m", None)
    calls.fmu = SimpleNamespace(
        getBooleanStatus=lambda kind: answer(terminated) if kind == 3 else None,
        getRealStatus=lambda kind: answer(last) if kind == 2 else None,
    )
    return calls.end_time(1.0)


def test_the_time_to_which_an_fmu_came_is_what_it_says_and_not_before_the_step() -> None:
    assert ended_by(True, 1.25) == 1.25
    assert ended_by(True, 0.5) == 1.0
    assert ended_by(True, RuntimeError("not there")) == 1.0
    assert ended_by(False, 1.25) is None
    assert ended_by(RuntimeError("not there"), 1.25) is None
    assert CoSimulation1("m", None).end_time(1.0) is None


@pytest.mark.parametrize(
    ("status", "terminate", "early", "reached"),
    [
        (OK, True, False, 1.5),
        (OK, True, True, 1.2),
        (WARNING, True, False, 1.5),
        (OK, False, True, None),
        (DISCARD, True, True, None),
    ],
)
def test_fmi_3_ends_by_a_flag_of_its_step(status: int, terminate: bool, early: bool, reached: float | None) -> None:
    def do_step(component: Any, t: float, h: float, no_set: bool, *flags: Any) -> int:
        for flag, value in zip(flags, (False, terminate, early, 1.2), strict=True):
            flag._obj.value = value
        assert (t, h, no_set) == (1.0, 0.5, True)
        return status

    calls = CoSimulation3("m", None)
    calls.bare_step = lambda: do_step  # type: ignore[method-assign]
    if reached is None:
        assert calls.stepping()(ctypes.c_void_p(), 1.0, 0.5, 1) == status
    else:
        with pytest.raises(EarlyEnd) as end:
            calls.stepping()(ctypes.c_void_p(), 1.0, 0.5, 1)
        assert end.value.reached == reached


@pytest.mark.parametrize(
    ("categories", "kept"),
    [
        (["logStatusWarning", "logEvents", "logStatusError"], ["logStatusWarning", "logStatusError"]),
        (["logStatusError"], None),  # all of them as it is
        (["logEvents"], None),  # none says what went wrong
        ([], None),
        (["logAll", "logEvents"], ["logAll"]),
    ],
)
def test_an_fmu_is_asked_to_log_what_goes_wrong_alone(categories: list[str], kept: list[str] | None) -> None:
    asked: list[Any] = []
    calls = CoSimulation2("m", SimpleNamespace(logCategories=[SimpleNamespace(name=name) for name in categories]))
    calls.fmu = SimpleNamespace(setDebugLogging=lambda on, names: asked.append((on, names)))
    calls.limit_logging()
    assert asked == ([] if kept is None else [(True, kept)])
