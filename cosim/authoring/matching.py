"""Matching of FMU outputs to inputs by type, unit and name."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import SequenceMatcher
from functools import cache
from types import MappingProxyType

from cosim.blocks.component import Signal
from cosim.blocks.fmi_types import is_compatible

WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
IGNORED_WORDS = {"in", "out", "input", "output", "signal", "value"}
MIN_SCORE = 0.6  # required score: similar names, or less similar ones of the same unit
# score changes: equal units, a unit on one side only, an output already connected
SAME_UNIT, ONE_UNIT, USED_OUTPUT = 0.3, -0.15, -0.4
# words of reference signals, never connected to measurements
REFERENCES = {"ref", "reference", "set", "setpoint", "sp", "target", "desired", "des"}
PREFIX_SIMILARITY, LETTER_SIMILARITY = 0.8, 0.5  # of words: one begins with the other, or by common letters
MAX_CANDIDATES = 5  # listed per input
MIN_LEAD = 0.1  # difference of scores too small for a decision

Port = tuple[str, Signal]  # component, signal


@dataclass(frozen=True)
class Match:
    """A connection found by matching names and units.

    Attributes:
        guess: Basis of the match; "" for equal names.
        others: Further fitting outputs.
    """

    source: Port
    target: Port
    guess: str = ""
    others: tuple[str, ...] = ()

    @property
    def factor(self) -> tuple[float, float]:
        """Return factor and offset of the unit conversion."""
        return self.source[1].conversion(self.target[1]) or (1.0, 0.0)


@dataclass(frozen=True)
class Matches:
    """Connections between FMUs, and inputs without a connection.

    Attributes:
        connections: Connections in the order of the inputs.
        unconnected: Unconnected inputs, each with the outputs that would fit.
        choices: Unconnected inputs for which several outputs are equally likely.
    """

    connections: tuple[Match, ...]
    unconnected: tuple[tuple[Port, tuple[str, ...]], ...]
    choices: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def any_candidate(self) -> bool:
        """Return whether some output fits some input."""
        return bool(self.connections) or any(candidates for _, candidates in self.unconnected)


def text(port: Port) -> str:
    """Return a port as `component.variable`; an element of an array has the name of the array."""
    return f"{port[0]}.{port[1].array or port[1].name}"


def match_ports(
    outputs: Sequence[Port], inputs: Sequence[Port], sizes: Mapping[str, int] = MappingProxyType({})
) -> Matches:
    """Connect outputs to inputs of other components, each once.

    Equal names come first, then similar ones. Equally likely outputs are left to the user.

    Args:
        sizes: Number of elements of each array, by name `component.variable`.
    """
    return _Matching(outputs, inputs, sizes).matches()


class _Matching:
    """Connections so far; `open` holds the inputs without a decision, by name."""

    def __init__(self, outputs: Sequence[Port], inputs: Sequence[Port], sizes: Mapping[str, int]) -> None:
        self.inputs = {text(i): i for i in inputs}
        self.candidates = {
            name: [o for o in outputs if o[0] != i[0] and fits(o, i, sizes)] for name, i in self.inputs.items()
        }
        self._scores: dict[str, dict[str, float]] = {}  # input → output → similarity of name and unit
        self._has_similar: dict[str, bool] = {}  # inputs with similar outputs; used ones may be ranked below others
        self._likely_of: dict[str, list[tuple[float, Port]]] = {}  # input → likely outputs, until one is connected
        self.open = dict(self.inputs)
        self.connections: dict[str, Match] = {}
        self.choices: dict[str, Sequence[Port]] = {}
        self.used: set[str] = set()  # connected outputs

    def matches(self) -> Matches:
        """Connect equal names, similar names, then remaining unique pairs."""
        self._connect_same_names()
        while best := self._best():
            target, (source, *others) = best
            why = "similar name" + (", same unit" if _units_agree(source[1], target[1]) else "")
            self._connect(Match(source, target, why, tuple(map(text, others[: MAX_CANDIDATES - 1]))))
        for name, target in [*self.open.items()]:
            if likely := self._likely(target):
                self._leave(name, [s for score, s in likely if likely[0][0] - score < MIN_LEAD])
        self._connect_remaining()
        connections = tuple(self.connections[name] for name in self.inputs if name in self.connections)
        unconnected = []
        for name, target in self.inputs.items():
            if name not in self.connections:
                candidates = map(text, [*self.choices.get(name, ()), *self.candidates[name]])
                unconnected.append((target, tuple(dict.fromkeys(candidates))[:MAX_CANDIDATES]))
        choices = {name: tuple(map(text, ports)) for name, ports in self.choices.items()}
        return Matches(connections, tuple(unconnected), choices)

    def _connect(self, match: Match) -> None:
        del self.open[text(match.target)]
        self.connections[text(match.target)] = match
        self.used.add(source := text(match.source))
        self._likely_of = {
            name: likely for name, likely in self._likely_of.items() if not self._is_affected(name, likely, source)
        }

    def _leave(self, name: str, sources: Sequence[Port]) -> None:
        """Leave an input unconnected and record the likely outputs, from which the user must choose."""
        del self.open[name]
        self.choices[name] = sources

    def _connect_same_names(self) -> None:
        for name, target in self.inputs.items():
            same = [o for o in self.candidates[name] if o[1].name == target[1].name]
            if len(same) == 1:
                self._connect(Match(same[0], target))
            elif same:
                self._leave(name, same)

    def _likely(self, target: Port) -> list[tuple[float, Port]]:
        """Return an input's likely outputs with scores, best first."""
        name = text(target)
        if name not in self._likely_of:
            self._likely_of[name] = self._rank(name, target)
        return self._likely_of[name]

    def _rank(self, name: str, target: Port) -> list[tuple[float, Port]]:
        """Compare an input with outputs, each pair once; return the likely outputs with scores, best first."""
        if name not in self._scores:
            self._scores[name] = {
                text(o): similarity(o[1].name, target[1].name) + _unit_score(o[1], target[1])
                for o in self.candidates[name]
            }
            self._has_similar[name] = any(score >= MIN_SCORE for score in self._scores[name].values())
        scores = self._scores[name]
        scored = []
        for source in self.candidates[name]:
            score = scores[text(source)]
            scored.append((score + USED_OUTPUT * (text(source) in self.used), score, source))
        scored.sort(key=lambda s: -s[0])  # stable: equal ones keep file order
        if not scored or scored[0][1] < MIN_SCORE or scored[0][0] < MIN_SCORE / 2:
            return []
        return [(net, source) for net, score, source in scored if score >= MIN_SCORE]

    def _is_affected(self, name: str, likely: Sequence[object], source: str) -> bool:
        """Return whether the use of an output changes the likely outputs of an input."""
        scores = self._scores[name]
        return scores.get(source, 0.0) >= MIN_SCORE or (not likely and source in scores and self._has_similar[name])

    def _best(self) -> tuple[Port, list[Port]] | None:
        """Return the input with the highest score and its likely outputs; None if no input has a clear best output."""
        best: tuple[float, Port, list[Port]] | None = None
        for target in self.open.values():
            likely = self._likely(target)
            if not likely or (likely[1:] and likely[0][0] - likely[1][0] < MIN_LEAD):
                continue
            if best is None or likely[0][0] > best[0]:
                best = likely[0][0], target, [source for _, source in likely]
        return None if best is None else best[1:]

    def _connect_remaining(self) -> None:
        """Connect each input that a single unused output fits, unless that output also fits another such input."""
        sources: dict[str, Port] = {}
        for name, target in self.open.items():
            is_reference = _is_reference(target[1].name)
            free = [o for o in self.candidates[name] if text(o) not in self.used]
            free = [o for o in free if _is_reference(o[1].name) == is_reference]
            if len(free) == 1:
                sources[name] = free[0]
        demand = Counter(map(text, sources.values()))
        for name, source in sources.items():
            if demand[text(source)] == 1:
                self._connect(Match(source, self.inputs[name], "nothing else is left that fits"))


def fits(source: Port, target: Port, sizes: Mapping[str, int]) -> bool:
    """Return whether types, dimensions and array sizes agree."""
    a, b = source[1], target[1]
    same_size = sizes.get(text(source), 1) == sizes.get(text(target), 1)
    return same_size and is_compatible(a.kind, b.kind) and a.conversion(b) is not None


def similarity(a: str, b: str) -> float:
    """Return the similarity of two names, 0 … 1."""
    first, second = sorted((_words(a), _words(b)), key=len)
    if not first or _is_reference(a) != _is_reference(b):
        return 0.0
    scores = [max(_word_similarity(x, y) for y in second) for x in first]
    return sum(scores) / len(scores) * (0.75 + 0.25 * len(first) / len(second))


@cache
def _words(name: str) -> list[str]:
    words = [word.lower() for word in WORDS.findall(name)]
    return [word for word in words if word not in IGNORED_WORDS] or words


@cache
def _is_reference(name: str) -> bool:
    return not REFERENCES.isdisjoint(_words(name))


@cache
def _word_similarity(a: str, b: str) -> float:
    if a == b:
        return 1.0
    if a.isdigit() or b.isdigit():
        return 0.0
    return (
        PREFIX_SIMILARITY
        if a.startswith(b) or b.startswith(a)
        else LETTER_SIMILARITY * SequenceMatcher(None, a, b).ratio()
    )


def _unit_score(a: Signal, b: Signal) -> float:
    return SAME_UNIT if _units_agree(a, b) else ONE_UNIT if bool(a.unit) != bool(b.unit) else 0.0


def _units_agree(a: Signal, b: Signal) -> bool:
    return bool(a.unit and b.unit) and {a.unit, b.unit} != {"1"}
