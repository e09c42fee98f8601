"""Which output of one FMU is meant for which input of another, by type, unit and name."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import SequenceMatcher
from types import MappingProxyType

from cosim.blocks.component import Signal
from cosim.blocks.fmi_types import goes

WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
SAY_NOTHING = {"in", "out", "input", "output", "signal", "value"}
ENOUGH = 0.6  # of a score: names alike, or less alike and of one unit
SAME_UNIT, ONE_UNIT, USED = 0.3, -0.15, -0.4  # of both; of one of them only; of an output that goes somewhere already
REFERENCES = {"ref", "reference", "set", "setpoint", "sp", "target", "desired", "des"}  # which no measurement is
PREFIX, OTHER = 0.8, 0.5  # of two words: one begins with the other; they share letters
MOST = 5  # candidates that are named for an input
CLOSE = 0.1  # of scores: so near to each other they do not tell which is meant

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
    """Connections by input, in the order of the inputs, and the inputs left, each with outputs that would fit.

    choices: of the inputs left, those for which several outputs are as likely, with these
    """

    found: tuple[Match, ...]
    left: tuple[tuple[Port, tuple[str, ...]], ...]
    choices: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


def text(port: Port) -> str:
    """`component.variable`, of an element the whole array's."""
    return f"{port[0]}.{port[1].array or port[1].name}"


def matched(
    outputs: Sequence[Port], inputs: Sequence[Port], sizes: Mapping[str, int] = MappingProxyType({})
) -> Matches:
    """Connect outputs to inputs of other components: those of the same name, then by likeness, each once.

    Where several are as likely none is taken: that is a choice.

    sizes: of arrays, `component.variable` → number of elements
    """
    fits = {text(i): [o for o in outputs if o[0] != i[0] and fit(o, i, sizes)] for i in inputs}
    found: dict[str, Match] = {}
    choices: dict[str, Sequence[Port]] = {}
    for target in inputs:
        same = [o for o in fits[text(target)] if o[1].name == target[1].name]
        if len(same) == 1:
            found[text(target)] = Match(same[0], target)
        elif same:
            choices[text(target)] = same
    used = {text(m.source) for m in found.values()}
    open_ = [i for i in inputs if text(i) not in found and text(i) not in choices]
    while best := _best(open_, fits, used):
        target, (likely, *others) = best
        why = "similar name" + (", same unit" if _units_agree(likely[1], target[1]) else "")
        found[text(target)] = Match(likely, target, why, tuple(map(text, others[: MOST - 1])))
        used.add(text(likely))
        open_ = [i for i in open_ if text(i) != text(target)]
    for target in open_:
        if likely_ones := _likely(target, fits[text(target)], used):
            choices[text(target)] = [s for score, s in likely_ones if likely_ones[0][0] - score < CLOSE]
    for match in _only_ones([i for i in open_ if text(i) not in choices], fits, used):
        found[text(match.target)] = match
    ordered = tuple(found[text(i)] for i in inputs if text(i) in found)
    left = []
    for target in (i for i in inputs if text(i) not in found):
        first = [*choices.get(text(target), ()), *fits[text(target)]]
        left.append((target, tuple(dict.fromkeys(map(text, first)))[:MOST]))
    return Matches(ordered, tuple(left), {name: tuple(map(text, sources)) for name, sources in choices.items()})


def fit(source: Port, target: Port, sizes: Mapping[str, int] = MappingProxyType({})) -> bool:
    """Types go, dimensions agree, and an array has as many elements."""
    a, b = source[1], target[1]
    same_size = sizes.get(text(source), 1) == sizes.get(text(target), 1)
    return same_size and goes(a.kind, b.kind) and a.conversion(b) is not None


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


def _likely(target: Port, fitting: Sequence[Port], used: Collection[str]) -> list[tuple[float, Port]]:
    """Outputs that are likely enough for an input, with their scores, the likeliest first."""
    scored = []
    for source in fitting:
        score = alike(source[1].name, target[1].name) + _of_units(source[1], target[1])
        scored.append((score + USED * (text(source) in used), score, source))
    scored.sort(key=lambda s: -s[0])  # stable: of equal ones the first of the file
    if not scored or scored[0][1] < ENOUGH or scored[0][0] < ENOUGH / 2:
        return []
    return [(net, source) for net, score, source in scored if score >= ENOUGH]


def _best(
    inputs: Sequence[Port], fits: Mapping[str, Sequence[Port]], used: Collection[str]
) -> tuple[Port, list[Port]] | None:
    """The input of the likeliest pair, and what is likely for it; None where no pair stands out."""
    best: tuple[float, Port, list[Port]] | None = None
    for target in inputs:
        likely = _likely(target, fits[text(target)], used)
        if not likely or (likely[1:] and likely[0][0] - likely[1][0] < CLOSE):
            continue
        if best is None or likely[0][0] > best[0]:
            best = likely[0][0], target, [source for _, source in likely]
    return None if best is None else best[1:]


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
