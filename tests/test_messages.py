"""Messages keep their codes through exceptions and pickles, and show them with -v and in JSON."""

from __future__ import annotations

import json
import pickle
from collections.abc import Iterator
from pathlib import Path

import pytest

from cosim.base.errors import (
    CosimError,
    Fault,
    InputError,
    NotExecuted,
    SimulationError,
    SweepStopped,
    Terminated,
)
from cosim.base.messages import Message, Template, code_of
from cosim.blocks.component import EarlyEnd
from tests.warm import cosim

MADE = Template("E-TST-001", "is {value:.1f} s; the largest is {most:g} s")
MESSAGE = MADE(value=2.25, most=1.0)


def test_a_message_keeps_code_and_fields_through_exceptions_pickles_and_prefixes() -> None:
    message = MADE(value=2.25, most=1.0)
    assert (message, message.code, message.fields["most"]) == ("is 2.2 s; the largest is 1 s", "E-TST-001", 1.0)
    assert code_of(message.after("a.yaml: ")) == code_of(pickle.loads(pickle.dumps(message))) == "E-TST-001"
    assert message.after("a.yaml: ") == "a.yaml: is 2.2 s; the largest is 1 s"
    assert str(ValueError(message)).code == "E-TST-001"  # type: ignore[attr-defined]
    assert Fault(Path("a"), 0, 0, message).code == SimulationError("a", 0.0, message).code == "E-TST-001"
    error = pickle.loads(pickle.dumps(InputError.at(Path("a"), message)))
    assert error.faults[0].code == "E-TST-001"


def all_errors() -> Iterator[BaseException]:
    """One error of every class of the tree."""
    texts, stops = [CosimError], [SimulationError]
    yield from (InputError([Fault(Path("b"), 1, 2, MESSAGE), Fault(Path("a"), 0, 0, MESSAGE, 3)]), InputError([]))
    yield from (NotExecuted(Path("a.py")), Terminated("SIGHUP"), EarlyEnd("a", 1.5, MESSAGE, readable=True))
    while texts:
        kind = texts.pop()
        texts += [k for k in kind.__subclasses__() if k not in {InputError, NotExecuted, SimulationError}]
        yield kind(MESSAGE)
    while stops:
        kind = stops.pop()
        stops += [k for k in kind.__subclasses__() if k.__module__ == "cosim.base.errors"]
        yield kind("a", 0.5, MESSAGE)


@pytest.mark.parametrize("error", [*all_errors()], ids=lambda error: type(error).__name__)
def test_every_error_survives_a_pickle_with_code_and_fields(error: BaseException) -> None:
    if isinstance(error, SimulationError):
        error.left = Path("results")
    if isinstance(error, SweepStopped):
        error.exit_code = 4  # ended by a signal
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert (str(again), again.args, vars(again)) == (str(error), error.args, vars(error))
    assert code_of(again) == code_of(error) == getattr(error, "code", "E-BAS-002")
    if isinstance(error.args[0], Message):
        assert again.args[0].fields == error.args[0].fields
    if not isinstance(error, InputError) or error.faults:
        assert code_of(error)
        assert again.exit_code == error.exit_code  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    "line",
    [
        ("run",),
        *(
            pytest.param(x, marks=pytest.mark.thorough)
            for x in (("run", "a", "--none"), ("none",), ("run", "a", "--seed", "x"))
        ),
    ],
)
def test_a_wrong_command_line_has_a_code(line: tuple[str, ...]) -> None:
    for option in ((), ("-v",)):
        answer = cosim(*line, *option)
        assert answer.returncode == 2
        assert answer.stderr.rstrip().endswith(" [E-CLI-018]") == bool(option)
    answer = json.loads(cosim(*line, "--json").stdout)
    assert (answer["code"], answer["exit_code"], answer["faults"]) == ("E-CLI-018", 2, [])


def test_a_missed_tolerance_has_the_code_of_its_first_reason(tmp_path: Path) -> None:
    for name, value in (("a", 1), ("b", 2)):
        (tmp_path / f"{name}.csv").write_text(f"time,x,y{name}\n0,0,0\n1,{value},0\n")
    answer = cosim("compare", tmp_path / "a.csv", tmp_path / "b.csv", "--tol", "0.1", "-v", "--out", tmp_path / "out")
    assert answer.returncode == 5
    assert answer.stderr.strip().endswith("missing in " + f"{tmp_path / 'b.csv'}: ya [E-CMP-009]")


def test_the_code_is_shown_with_v_and_in_json(tmp_path: Path) -> None:
    quiet, verbose = (cosim("report", tmp_path, *option) for option in ((), ("-v",)))
    assert (quiet.returncode, verbose.returncode) == (2, 2)
    assert quiet.stderr.strip().endswith("`cosim run`")
    assert verbose.stderr.strip().endswith("`cosim run` [E-CMP-006]")
    asked = cosim("compare", tmp_path / "a", tmp_path / "b", "--json")
    assert {fault["code"][:2] for fault in json.loads(asked.stdout)["faults"]} == {"E-"}
