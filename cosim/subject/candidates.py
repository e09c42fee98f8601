"""Hypotheses about a subject: an effect that is missing, an error of a sensor, a parameter that is wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from cosim.model.quantities import Parameter

Kind = Literal["effect", "sensor", "parameter"]


@dataclass(frozen=True)
class Candidate:
    """A hypothesis: its free parameters and the values from which its fit starts.

    gain: it multiplies an input, and so may stand for one number that is wrong
    """

    name: str
    kind: Kind
    free: tuple[Free, ...]
    starts: tuple[Mapping[str, float], ...]
    gain: bool = False

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of its parameters."""
        return tuple(f.name for f in self.free)


def effect(
    name: str,
    declared: Sequence[Parameter],
    values: Mapping[str, float],
    *,
    kind: Kind = "effect",
    starts: Sequence[Mapping[str, float]] = (),
    above: Mapping[str, str] | None = None,
    gain: bool = False,
) -> Candidate:
    """Return an effect or an error of a sensor as a candidate; its parameters are called `name.parameter`.

    declared: its parameters, by their own names; values: those of the subject, by the whole names
    starts:   further values, by their own names, from which a fit starts; the first are zero or the usual size
    above:    parameter → another of the effect that it is never below
    """

    def whole(own: str) -> str:
        return f"{name}.{own}"

    free = tuple(
        Free(
            whole(p.name),
            *p.bounds,
            usual_size(p),
            neutral=p.neutral,
            above=whole(above[p.name]) if above and p.name in above else "",
        )
        for p in declared
    )
    first = {whole(p.name): _start(p, values[whole(p.name)]) for p in declared}
    others = ({whole(own): value for own, value in start.items()} for start in starts)
    return Candidate(name, kind, free, (first, *others), gain)


def _start(p: Parameter, value: float) -> float:
    """One-sided parameters start at a size that is detected, two-sided ones at neutral, between the signs."""
    one_sided = p.neutral is not None and p.neutral == p.bounds[0]
    return p.typical if one_sided and p.typical else value


def usual_size(p: Parameter) -> float:
    """By which it is usually off, or met."""
    return p.typical or 0.3 * abs(float(p.default)) or 0.1


@dataclass(frozen=True)
class Free:
    """A parameter that a fit may move: limits, the size by which it is measured, and a prior where there is one.

    neutral: where its effect does nothing; None of a base parameter
    parameter, group: what it is the value of, and of which group of logs, where each has its own
    above:   another parameter, below which it may not be
    """

    name: str
    low: float
    high: float
    size: float
    prior: tuple[float, float] | None = None  # mean, standard deviation
    neutral: float | None = None
    parameter: str = ""
    group: str = ""
    above: str = ""
