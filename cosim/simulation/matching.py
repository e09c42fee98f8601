"""Which output of one FMU is meant for which input of another, by type, unit and name."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher

from cosim.blocks.interface import Signal
from cosim.blocks.kinds import goes

WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
SAY_NOTHING = {"in", "out", "input", "output", "signal", "value"}
ENOUGH = 0.6  # of a score: names alike, or less alike and of one unit
SAME_UNIT, ONE_UNIT, USED = 0.3, -0.15, -0.4  # of both; of one of them only; of an output that goes somewhere already
REFERENCES = {"ref", "reference", "set", "setpoint", "sp", "target", "desired", "des"}  # which no measurement is
PREFIX, OTHER = 0.8, 0.5  # of two words: one begins with the other; they share letters
MOST = 5  # candidates that are named for an input

Port = tuple[str, Signal]  # component, signal


@dataclass(frozen=True)
class Match:
    """A connection that was found; `guess`: on what it rests where names are not the same; `others`: what else fits."""

    source: Port
    target: Port
    guess: str = ""
    others: tuple[str, ...] = ()

    @property
    def factor(self) -> tuple[float, float]:
        """Factor and offset by which units are converted."""
        return self.source[1].conversion(self.target[1]) or (1.0, 0.0)


@dataclass(frozen=True)
class Matches:
    """Connections by input, in the order of the inputs, and the inputs left, each with outputs that would fit."""

    found: tuple[Match, ...]
    left: tuple[tuple[Port, tuple[str, ...]], ...]


def text(port: Port) -> str:
    """`component.variable`, of an element the whole array's."""
    return f"{port[0]}.{port[1].array or port[1].name}"


def matched(outputs: Sequence[Port], inputs: Sequence[Port]) -> Matches:
    """Connect outputs to inputs of other components: those of the same name, then by likeness, each once."""
    fits = {text(i): [o for o in outputs if o[0] != i[0] and fit(o[1], i[1])] for i in inputs}
    found: dict[str, Match] = {}
    for target in inputs:
        same = [o for o in fits[text(target)] if o[1].name == target[1].name]
        if same:
            others = tuple(text(o) for o in same[1:])
            found[text(target)] = Match(same[0], target, "several have this name" if others else "", others)
    used = {text(m.source) for m in found.values()}
    open_ = [i for i in inputs if text(i) not in found]
    while best := _best(open_, fits, used):
        _, target, source, others = best
        why = "similar name" + (", same unit" if _units_agree(source[1], target[1]) else "")
        found[text(target)] = Match(source, target, why, others)
        used.add(text(source))
        open_ = [i for i in open_ if text(i) != text(target)]
    for match in _only_ones(open_, fits, used):
        found[text(match.target)] = match
    ordered = tuple(found[text(i)] for i in inputs if text(i) in found)
    left = tuple((i, tuple(text(o) for o in fits[text(i)][:MOST])) for i in inputs if text(i) not in found)
    return Matches(ordered, left)


def fit(source: Signal, target: Signal) -> bool:
    """Types go, dimensions agree, and an array stays one."""
    return goes(source.kind, target.kind) and source.conversion(target) is not None


def alike(a: str, b: str) -> float:
    """How alike two names are, 0 … 1: their words in common, or beginnings of one another."""
    first, second = sorted((_words(a), _words(b)), key=len)
    if not first or _is_reference(a) != _is_reference(b):
        return 0.0
    each = [max(_word(x, y) for y in second) for x in first]
    return sum(each) / len(each) * (0.75 + 0.25 * len(first) / len(second))


def _words(name: str) -> list[str]:
    found = [word.lower() for word in WORDS.findall(name)]
    return [word for word in found if word not in SAY_NOTHING] or found


def _is_reference(name: str) -> bool:
    return not REFERENCES.isdisjoint(_words(name))


def _word(a: str, b: str) -> float:
    if a == b:
        return 1.0
    if a.isdigit() or b.isdigit():
        return 0.0
    return PREFIX if a.startswith(b) or b.startswith(a) else OTHER * SequenceMatcher(None, a, b).ratio()


def _of_units(a: Signal, b: Signal) -> float:
    return SAME_UNIT if _units_agree(a, b) else ONE_UNIT if bool(a.unit) != bool(b.unit) else 0.0


def _units_agree(a: Signal, b: Signal) -> bool:
    return bool(a.unit and b.unit) and {a.unit, b.unit} != {"1"}


def _best(
    inputs: Sequence[Port], fits: Mapping[str, Sequence[Port]], used: Collection[str]
) -> tuple[float, Port, Port, tuple[str, ...]] | None:
    """The likeliest pair with its score, and what else would do for its input; None where none is likely enough."""
    best: tuple[float, Port, Port, tuple[str, ...]] | None = None
    for target in inputs:
        scored = []
        for source in fits[text(target)]:
            score = alike(source[1].name, target[1].name) + _of_units(source[1], target[1])
            scored.append((score + USED * (text(source) in used), score, source))
        scored.sort(key=lambda s: -s[0])  # stable: of equal ones the first of the file
        if (
            scored
            and scored[0][1] >= ENOUGH
            and scored[0][0] >= ENOUGH / 2
            and (best is None or scored[0][0] > best[0])
        ):
            others = tuple(text(s) for _, score, s in scored[1:MOST] if score >= ENOUGH)
            best = scored[0][0], target, scored[0][2], others
    return best


def _only_ones(inputs: Sequence[Port], fits: Mapping[str, Sequence[Port]], used: Collection[str]) -> list[Match]:
    """Inputs for which one output alone is left, and which are alone in wanting it."""
    free = {
        text(i): [
            o for o in fits[text(i)] if text(o) not in used and _is_reference(o[1].name) == _is_reference(i[1].name)
        ]
        for i in inputs
    }
    wanted = [text(sources[0]) for sources in free.values() if len(sources) == 1]
    return [
        Match(free[text(i)][0], i, "nothing else is left that fits")
        for i in inputs
        if len(free[text(i)]) == 1 and wanted.count(text(free[text(i)][0])) == 1
    ]
