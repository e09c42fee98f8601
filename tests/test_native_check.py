"""What is printed of a model is compared with its Python before it is compiled; what differs is refused at its line."""

from __future__ import annotations

from pathlib import Path

import pytest

from cosim.core.errors import InputError
from cosim.estimation.kernel.backend import kernel
from cosim.fmi.building.build import build_native
from cosim.fmi.building.file import load_model
from tests.native import NEEDS_COMPILER
from tests.test_native import TIGHT, by_fmu, by_python, difference, wandering

pytestmark = NEEDS_COMPILER

ROTOR = """
from dataclasses import dataclass

from cosim.model import Delay, Effect, Equations, Model, Quantity as Q, overrides, parameter


class Term(Effect):
    def moment(self, m, rate, side):
        return 0.0


@dataclass(frozen=True, kw_only=True)
class Late(Delay):
    name = "late"
    memory = (Q("torque", "N.m", "torque"),)
    #late


@dataclass(frozen=True, kw_only=True)
class Drag(Term):
    name = "drag"
    equation = "moment"
    level: float = parameter(0.0, unit="1", bounds=(0, 2), neutral=0.0, typical=0.3, doc="drag")
    left: bool = parameter(True, unit="", doc="stronger on the left")

    def moment(self, m, rate, side):
        return -self.level * rate if (side == "left") is self.left else -3.0 * self.level * m.tanh(rate)


@dataclass(frozen=True, kw_only=True)
class Lag(Effect):
    name = "lag"
    equation = "lag"
    share: float = parameter(0.0, unit="1", bounds=(0, 1), neutral=0.0, typical=0.5, doc="share of what was before")
    memory = (Q("before", "N.m", "torque before", 1.0),)

    def remember(self, t, start):
        return (2.0 * start[0] + 0.1,)

    def shape(self, m, t, h, command, memory):
        torque = self.share * memory[0] + (1 - self.share) * command[0]
        return (torque,), (torque,)


@dataclass(frozen=True, kw_only=True)
class Rotor(Model):
    base_states = (Q("left", "rad/s", "left", 0.3), Q("right", "rad/s", "right", -0.2))
    inputs = (Q("torque", "N.m", "torque", 0.4),)
    outputs = base_states
    forced = ("left",)
    catalogue = (Late, Drag, Lag)
    sensor_variance = {"left": 1e-6}
    order: float = parameter(2.0, unit="1", bounds=(1, 4), doc="order of the law")
    #more

    def equations(self, m):
        terms = overrides(tuple(e for e in self.awake if isinstance(e, Term)), "moment", Term)

        def derivative(t, state, command):
            left, right = command[0] - state[0], command[0] - self.order * state[1]
            for term in terms:
                left = left + term.moment(m, state[0], "left")
                right = right + term.moment(m, state[1], "right")
            #last
            return left, right

        return Equations(derivative, lambda t, state, command: state)
"""


def rotor(folder: Path, at: str, line: str) -> str:
    """The model with other lines in one place."""
    text = ROTOR.replace(at, line)
    assert text != ROTOR
    (folder / "rotor.py").write_text(text, encoding="utf-8")
    return f"{folder}/rotor.py:Rotor"


def line_of(folder: Path, words: str) -> int:
    text = (folder / "rotor.py").read_text(encoding="utf-8")
    return text[: text.index(words)].count("\n") + 1


def test_hooks_are_told_apart_by_a_text_and_memory_starts_by_the_models_rule(tmp_path: Path) -> None:
    own = rotor(tmp_path, "#more", "")
    model = load_model(own, Path()).model
    (built,) = build_native(tmp_path, own)
    rows = wandering(model, 100)
    for values in (
        {"drag.level": 0.5},
        {"lag.share": 0.7, "drag.level": 1.0, "drag.left": False},
        {"late.time": 0.033},
    ):
        assert difference(by_python(model, rows, values, 0.02), by_fmu(built.path, rows, values, 0.02)) < TIGHT


@pytest.mark.parametrize(
    ("at", "line", "place"),
    [
        ("#last", "left = m.where(self.order == 1.0, left, 2 * left)", "self.order =="),
        ("#last", "left = left if state[0] - state[1] != 0 else 0.0", "state[0] - state[1]"),
        ("self.order * state", "{2.0: 5.0}.get(self.order, 1.0) * state", "def equations"),
        ("#last", "left = left * (1 + len(terms))", "def equations"),
        ("#late", "def shape(self, m, t, h, u, memory): return u, memory", "def shape"),
        ("#more", "\n    ".join(f'k{i}: bool = parameter(True, unit="", doc="k")' for i in range(5)), "k4"),
        ("#last", "left = left % 3.0", "left % 3.0"),
    ],
)
def test_what_c_would_say_otherwise_is_refused_at_its_line(at: str, line: str, place: str, tmp_path: Path) -> None:
    own = rotor(tmp_path, at, line)
    with pytest.raises(InputError) as error:
        build_native(tmp_path / "out", own)
    number = line_of(tmp_path, place) + (1 if place.startswith("\n") else 0)
    assert str(error.value).startswith(f"{tmp_path}/rotor.py:{number}:")
    assert not (tmp_path / "out").exists()


def test_a_filter_is_not_made_of_what_only_numbers_bear(tmp_path: Path) -> None:
    line = "torque = (2.0 if self.share == 1.0 else 1.0) *"
    model = load_model(rotor(tmp_path, "torque = self.share *", line), Path()).model
    with pytest.raises(InputError) as caught:
        kernel(model, [q.name for q in model.outputs])
    (fault,) = caught.value.faults
    assert (fault.file, fault.line) == (tmp_path / "rotor.py", line_of(tmp_path, "self.share =="))


def test_a_filter_takes_a_remainder_of_time(tmp_path: Path) -> None:
    model = load_model(rotor(tmp_path, "#last", "left = left + t % 3.0"), Path()).model
    assert kernel(model, [q.name for q in model.outputs]).layout.states
