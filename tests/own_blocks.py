"""Components of plain Python, put together by hand: systems for tests that need no FMU, no file and no process."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, MutableSequence, Sequence
from typing import Any

from cosim.blocks.component import Signal, in_turn
from cosim.system.schedule import Stage
from cosim.system.system import System
from cosim.system.wiring import Transfer

Law = Callable[[float, float, Sequence[float]], Sequence[float]]  # end of the step [s], its length [s], inputs


class Block:
    """A component whose outputs are a function of time, step and inputs; `calls` keeps what is asked of it."""

    nominal_step = False
    exact_inputs: tuple[Signal, ...] = ()
    exact_outputs: tuple[Signal, ...] = ()

    def __init__(self, name: str, inputs: Sequence[str], outputs: Sequence[str], law: Law, **options: Any) -> None:
        self.name, self.law = name, law
        self.inputs, self.outputs = tuple(map(Signal, inputs)), tuple(map(Signal, outputs))
        self.doing: MutableSequence[int] = [0]
        self.calls: list[tuple[str, str, int]] = []  # component, call, number that stands in `doing` meanwhile
        self.steps: list[tuple[float, float]] = []
        self.fails: tuple[str, int] | None = options.get("fails")  # call, and the how-manieth of its kind
        self.error: type[Exception] = options.get("error", RuntimeError)
        self._u: list[float] = [0.0] * len(inputs)
        self._at = 0.0, 0.0

    def depends_on(self, name: str, outputs: Collection[str] | None = None) -> bool | None:
        return False

    def bind(self, row: Any, first: int, beside: list[Any] | None = None, first_beside: int = 0) -> None:
        self._row, self._first = row, first

    def open(self, start: float, stop: float) -> None:
        self._note("open")
        self._at = start, 0.0

    def start(self) -> None:
        self._note("start")

    def put(self) -> None:
        self._note("put")
        self._u = list(self._row[self._first : self._first + len(self.inputs)])

    def get(self) -> None:
        self._note("get")
        first = self._first + len(self.inputs)
        self._row[first : first + len(self.outputs)] = list(self.law(*self._at, self._u))

    def advance(self, t: float, h: float) -> None:
        self._note("advance")
        self.steps.append((t, h))
        self._at = t + h, h

    def stepping(self, doing: MutableSequence[int], first: int) -> Callable[[float, float], None]:
        return in_turn(self, doing, first)  # type: ignore[arg-type]

    def close(self) -> None:
        self._note("close")

    def _note(self, call: str) -> None:
        self.calls.append((self.name, call, self.doing[0]))
        if self.fails and self.fails == (call, sum(made == call for _, made, _ in self.calls)):
            raise self.error(self.name, self._at[0], f"{call} failed")


def system_of(blocks: Sequence[Block], wires: Mapping[str, str], **options: Any) -> System:
    """Return a system that steps blocks in order; wires: target → source."""
    signals = {f"{block.name}.{signal.name}": signal for block in blocks for signal in (*block.inputs, *block.outputs)}
    columns = tuple(signals)
    transfers = [Transfer(columns.index(source), columns.index(target), target) for target, source in wires.items()]
    stages = tuple(
        Stage(block, tuple(t for t in transfers if t.name.partition(".")[0] == block.name), 1)  # type: ignore[arg-type]
        for block in blocks
    )
    return System(stages, (), columns=columns, units=dict.fromkeys(columns, ""), start=0.0, signals=signals, **options)
