"""Matching of FMU outputs to inputs by type, unit and name."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from functools import cache
from types import MappingProxyType

from cosim.blocks.component import Signal
from cosim.fmi.fmi_types import is_compatible

NAME_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
IGNORED_WORDS = {"in", "out", "input", "output", "signal", "value"}
MIN_SCORE = 0.6  # lowest score of a connection by similar names; half of it after the deduction for a used output
# score changes: equal units, a unit on one side only, an output already connected
SAME_UNIT, ONE_UNIT, USED_OUTPUT = 0.3, -0.15, -0.4
# words of reference signals, never connected to measurements
REFERENCES = {"ref", "reference", "set", "setpoint", "sp", "target", "desired", "des"}
PREFIX_SIMILARITY, LETTER_SIMILARITY = 0.8, 0.5  # for words: one begins with the other, or share of common letters
MAX_CANDIDATES = 5  # fitting outputs listed per input
MIN_LEAD = 0.1  # difference of scores too small for a decision

Port = tuple[str, Signal]  # (component, signal)


@dataclass(frozen=True)
class Match:
    """A connection found by matching names and units.

    Attributes:
        guess: Reason of a guessed match; "" for equal names.
        others: Other fitting outputs.
    """

    source: Port
    target: Port
    guess: str = ""
    others: tuple[str, ...] = ()


@dataclass(frozen=True)
class Matches:
    """Connections between FMUs, and inputs without a connection.

    Attributes:
        connections: Connections in the order of the inputs.
        unconnected: Unconnected inputs, each with the outputs that would fit, the most likely first.
    """

    connections: tuple[Match, ...]
    unconnected: tuple[tuple[Port, tuple[str, ...]], ...]

    @property
    def any_candidate(self) -> bool:
        """Return True if some output fits some input."""
        return bool(self.connections) or any(candidates for _, candidates in self.unconnected)


def text(port: Port) -> str:
    """Return a port as `component.variable`; an array element is shown by the name of the array."""
    return f"{port[0]}.{port[1].array or port[1].name}"


def match_ports(
    outputs: Sequence[Port], inputs: Sequence[Port], sizes: Mapping[str, int] = MappingProxyType({})
) -> Matches:
    """Connect outputs to inputs of other components; each input gets at most one output.

    Equal names are connected first, then similar names, then a single remaining pair. If several outputs fit equally
    well, the input is left to the user.

    Args:
        sizes: Number of elements of each array, by name `component.variable`.
    """
    open_ = {text(i): i for i in inputs}  # inputs that are not decided yet
    candidates: dict[str, list[Port]] = {}
    for name, (owner, signal) in open_.items():  # outputs whose type, unit and size agree
        candidates[name] = [
            o
            for o in outputs
            if o[0] != owner
            and sizes.get(text(o), 1) == sizes.get(name, 1)
            and is_compatible(o[1].kind, signal.kind)
            and o[1].conversion(signal) is not None
        ]
    connections: dict[str, Match] = {}
    choices: dict[str, Sequence[Port]] = {}  # likely outputs, from which the user must choose
    used: set[str] = set()

    def connect(source: Port, target: Port, guess: str = "", others: Sequence[Port] = ()) -> None:
        name = text(target)
        del open_[name]
        connections[name] = Match(source, target, guess, tuple(map(text, others[: MAX_CANDIDATES - 1])))
        used.add(text(source))

    for name, target in [*open_.items()]:
        same = [o for o in candidates[name] if o[1].name == target[1].name]
        if len(same) == 1:
            connect(same[0], target)
        elif same:
            choices[name] = same
            del open_[name]
    scores = {name: [(_score(o[1], i[1]), o) for o in candidates[name]] for name, i in open_.items()}
    while True:
        likely: dict[str, list[tuple[float, Port]]] = {}  # input → scores with their outputs, best first
        for name in open_:
            rated = [(score + USED_OUTPUT * (text(source) in used), score, source) for score, source in scores[name]]
            rated.sort(key=lambda s: -s[0])  # outputs of equal score keep the order of the file
            if rated and rated[0][1] >= MIN_SCORE and rated[0][0] >= MIN_SCORE / 2:
                likely[name] = [(net, source) for net, score, source in rated if score >= MIN_SCORE]
        clear = [name for name, ranked in likely.items() if len(_alike(ranked)) == 1]
        if not clear:
            break
        best = max(clear, key=lambda name: likely[name][0][0])
        source, *others = (port for _, port in likely[best])
        target = open_[best]
        why = "similar name" + (", same unit" if _units_agree(source[1], target[1]) else "")
        connect(source, target, why, others)
    for name, ranked in likely.items():
        choices[name] = _alike(ranked)
        del open_[name]
    only: dict[str, Port] = {}  # input → the only fitting output that is left
    for name, target in open_.items():
        free = [o for o in candidates[name] if text(o) not in used]
        free = [o for o in free if _is_reference(o[1].name) == _is_reference(target[1].name)]
        if len(free) == 1:
            only[name] = free[0]
    demand = Counter(map(text, only.values()))
    for name, source in only.items():
        if demand[text(source)] == 1:
            connect(source, open_[name], "the only fitting output left")
    unconnected = []
    for name, target in ((text(i), i) for i in inputs):
        if name not in connections:
            fitting = dict.fromkeys(map(text, [*choices.get(name, ()), *candidates[name]]))
            unconnected.append((target, tuple(fitting)[:MAX_CANDIDATES]))
    ordered = tuple(connections[name] for name in map(text, inputs) if name in connections)
    return Matches(ordered, tuple(unconnected))


def _alike(ranked: Sequence[tuple[float, Port]]) -> list[Port]:
    """Return the outputs whose scores are too close to the best score to choose one."""
    return [source for score, source in ranked if ranked[0][0] - score < MIN_LEAD]


def _score(a: Signal, b: Signal) -> float:
    """Return the score of a connection: similarity of the names (0 … 1) plus a bonus for equal units."""
    unit = SAME_UNIT if _units_agree(a, b) else ONE_UNIT if bool(a.unit) != bool(b.unit) else 0.0
    first, second = sorted((_words(a.name), _words(b.name)), key=len)
    if not first or _is_reference(a.name) != _is_reference(b.name):
        return unit
    scores = [max(_word_similarity(x, y) for y in second) for x in first]
    return unit + sum(scores) / len(scores) * (0.75 + 0.25 * len(first) / len(second))


@cache
def _words(name: str) -> list[str]:
    words = [word.lower() for word in NAME_WORD.findall(name)]
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
    if a.startswith(b) or b.startswith(a):
        return PREFIX_SIMILARITY
    return LETTER_SIMILARITY * SequenceMatcher(None, a, b).ratio()


def _units_agree(a: Signal, b: Signal) -> bool:
    return bool(a.unit and b.unit) and {a.unit, b.unit} != {"1"}
