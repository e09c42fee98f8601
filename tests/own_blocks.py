"""Components of plain Python, put together by hand: systems for tests that need no FMU, no file and no process."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, MutableSequence, Sequence
from typing import Any

from cosim.blocks.component import Signal, in_turn
from cosim.isolation.rows import Rows
from cosim.system.schedule import Stage
from cosim.system.system import System
from cosim.system.wiring import Transfer

Call = tuple[str, str, int]  # component, call, number that stands in `Rows.doing` meanwhile
Law = Callable[[float, float, Sequence[float]], Sequence[float]]  # end of the step [s], its length [s], inputs


class Block:
    """A component whose outputs are a function of time, step and inputs; `calls` keeps what is asked of it."""

    nominal_step = False
    exact_inputs: tuple[Signal, ...] = ()
    exact_outputs: tuple[Signal, ...] = ()

    def __init__(self, name: str, inputs: Sequence[str], outputs: Sequence[str], law: Law, **options: Any) -> None:
        self.name, self.law = name, law
        self.inputs, self.outputs = tuple(map(Signal, inputs)), tuple(map(Signal, outputs))
        self.direct: Mapping[str, Any] = options.get("direct", {})
        self.doing: MutableSequence[int] = [0]
        self.calls: list[Call] = []
        self.steps: list[tuple[float, float]] = []
        self.fails: tuple[str, int] | None = options.get("fails")  # call, and the how-manieth of its kind
        self.error: type[Exception] = options.get("error", RuntimeError)
        self._u: list[float] = [0.0] * len(inputs)
        self._at = 0.0, 0.0

    def depends_on(self, name: str, outputs: Collection[str] | None = None) -> bool | None:
        return self.direct.get(name, False)

    def bind(self, row: Any, first: int, beside: list[Any] | None = None, first_beside: int = 0) -> None:
        self._row, self._first = row, first

    def open(self, start: float, stop: float) -> None:
        self._note("open")
        self._at, self.span = (start, 0.0), (start, stop)

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
        return in_turn(self, doing, first)

    def close(self) -> None:
        self._note("close")

    def _note(self, call: str) -> None:
        self.calls.append((self.name, call, self.doing[0]))
        if self.fails and self.fails == (call, sum(made == call for _, made, _ in self.calls)):
            raise self.error(self.name, self._at[0], f"{call} failed")


def system_of(
    blocks: Sequence[Block],
    wires: Mapping[str, str],
    held: Collection[str] = (),
    every: Mapping[str, int] | None = None,
    start: float = 0.0,
    **options: Any,
) -> System:
    """Return a system that steps blocks in order.

    wires: target → source; held: targets with values of the step's start
    """
    columns = [f"{block.name}.{signal.name}" for block in blocks for signal in (*block.inputs, *block.outputs)]
    place = {column: number for number, column in enumerate(columns)}
    transfers = [Transfer(place[source], place[target], target) for target, source in wires.items()]
    stages = tuple(
        Stage(
            block,  # type: ignore[arg-type]
            tuple(t for t in transfers if t.name.partition(".")[0] == block.name and t.name not in held),
            (every or {}).get(block.name, 1),
        )
        for block in blocks
    )
    later = tuple(t for t in transfers if t.name in held)
    signals = {f"{b.name}.{s.name}": s for b in blocks for s in (*b.inputs, *b.outputs)}
    units = dict.fromkeys(columns, "")
    return System(stages, later, columns=tuple(columns), units=units, start=start, signals=signals, **options)


def rows_for(system: System, steps: int) -> Rows:
    """Return rows in memory, with a `doing` common to every block of a system."""
    rows = Rows.in_memory(steps + 1, len(system.columns))
    for stage in system.stages:
        stage.component.doing = rows.doing  # type: ignore[attr-defined]
    return rows
