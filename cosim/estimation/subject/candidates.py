"""Candidates for what a subject lacks: an effect, a sensor error, or a correct parameter value."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal

from cosim.core.arrays import NamedValues
from cosim.model.quantities import Parameter

if TYPE_CHECKING:
    from cosim.estimation.subject.interface import Subject

# default relative tolerance of a data sheet value, valid in 95 of 100 cases; recalibration within is no finding
DATA_SHEET_TOLERANCE = 0.02
SIGMAS_PER_TOLERANCE = 2.0  # standard deviations in a tolerance on each side

Kind = Literal["effect", "sensor", "parameter"]


@dataclass(frozen=True)
class Candidate:
    """An effect, sensor error or parameter that is tried, with its free parameters and start values for a fit.

    Attributes:
        complete: Values of a complete error, where a fit also starts because a fit from neutral may not reach them.
        repeats: Parameter that is a period, and the state in whose unit it is; () for none.
        among: Number of shapes that were tried before a fit, each of which counts as a candidate.
    """

    name: str
    kind: Kind
    free: tuple[Free, ...]
    starts: tuple[NamedValues, ...]
    complete: NamedValues = field(default_factory=dict)
    repeats: tuple[str, ...] = ()
    among: int = 1

    @property
    def parameters(self) -> tuple[str, ...]:
        """Return the parameter names."""
        return tuple(f.name for f in self.free)


def effect(
    name: str,
    declared: Sequence[Parameter],
    values: NamedValues,
    *,
    kind: Kind = "effect",
    starts: Sequence[NamedValues] = (),
    above: Mapping[str, str] = MappingProxyType({}),
) -> Candidate:
    """Return an effect or sensor error as a candidate with parameters `name.parameter`.

    Args:
        declared: Parameters, with short names (without `name.`).
        values: Full name → value in the subject.
        starts: Additional start values by short names; the first start is always zero or the usual size.
        above: Parameter → lower-bound parameter of the same effect.
    """
    free, first = [], {}
    for p in declared:
        full, least = f"{name}.{p.name}", above.get(p.name)
        lower = f"{name}.{least}" if least else ""
        free.append(Free(full, *p.bounds, usual_size(p), neutral=p.neutral, above=lower))
        first[full] = values[full]
        if p.typical and p.neutral == p.bounds[0]:
            first[full] = p.bounds[0] + p.typical  # detectable start value if the effect has one sign only
    others = ({f"{name}.{own}": value for own, value in start.items()} for start in starts)
    return Candidate(name, kind, tuple(free), (first, *others))


def usual_size(p: Parameter) -> float:
    """Return the typical change of a parameter, which scales start values and steps of a fit."""
    return p.typical or 0.3 * abs(float(p.default)) or 0.1


@dataclass(frozen=True)
class Free:
    """A free parameter of a fit.

    Attributes:
        low: Lower limit.
        high: Upper limit.
        size: Typical change of the value, which scales steps of the fit.
        prior: Mean and standard deviation; None without a prior.
        neutral: Value at which the effect vanishes; None for a base parameter.
        parameter: Name of the parameter if the value is for a group of logs; "" if common to all logs.
        group: Name of the group of logs.
        above: Name of a parameter that is the lower bound; "" for none.
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


def values_of_special_case(rich: Candidate, simple: Candidate, values: NamedValues) -> dict[str, float]:
    """Return parameter values with which a general effect (`rich`) equals a special one (`simple`).

    The result is empty if `simple` is not a special case of `rich`.

    A parameter with another parameter as lower bound, such as breakaway force and friction force, has no effect if both
    are equal. The special effect has only the lower one, under the same name.

    Args:
        values: Parameter values of the special effect.
    """
    named = {name.rpartition(".")[2]: values[name] for name in simple.parameters if name in values}
    equal: dict[str, float] = {}
    for f in rich.free:
        least = f.above.rpartition(".")[2]
        if f.above and least in named:
            equal |= {f.name: named[least], f.above: named[least]}
    return equal if simple.kind == rich.kind and len(simple.free) < len(rich.free) else {}


def base_parameters(subject: Subject, values: NamedValues, tolerance: NamedValues) -> list[Free]:
    """Return the base parameters that are free in every fit, with their priors.

    Args:
        tolerance: Parameter → relative tolerance from the study, which overrides that of the model.
    """
    stated = {p.name: p.tolerance for p in subject.parameters if p.tolerance is not None} | dict(tolerance)
    every = {**{name: stated.get(name, DATA_SHEET_TOLERANCE) for name in subject.calibrated}, **stated}
    return [base_parameter(subject, name, values, share) for name, share in every.items()]


def base_parameter(subject: Subject, name: str, values: NamedValues, tolerance: float | None) -> Free:
    """Return a base parameter as a free parameter of a fit, with a prior if a tolerance is stated."""
    p, value = subject.declared[name], values[name]
    prior = None if tolerance is None else (value, spread_of_base(p, value, tolerance))
    return Free(name, *p.bounds, 0.05 * _scale(p, value), prior)


def spread_of_base(p: Parameter, value: float, tolerance: float) -> float:
    """Return the prior standard deviation of a base parameter."""
    return tolerance * _scale(p, value) / SIGMAS_PER_TOLERANCE


def _scale(p: Parameter, value: float) -> float:
    return abs(value) or p.typical or abs(float(p.default)) or 1.0


# Parameters with a separate value for each group of logs are constant states θ in the filter. A group's known value has
# start variance 0; an unknown value starts at the expected value with the expected variance.


def own(name: str, group: str) -> str:
    """Return the name of a parameter's value in a group of logs."""
    return f"{name}@{group}"


def spread(name: str, group: str) -> str:
    """Return the name of the standard deviation of a group's value; if it has no value, the group's value is known."""
    return f"spread of {name}@{group}"


def drop_own_parameters(candidates: Sequence[Candidate], names: Sequence[str]) -> Iterator[Candidate]:
    """Yield the candidates without parameters that have a value per log and are free in every hypothesis."""
    for c in candidates:
        if free := tuple(f for f in c.free if f.name not in names):
            starts = tuple({n: v for n, v in s.items() if n not in names} for s in c.starts)
            yield replace(c, free=free, starts=starts)


def kind_within(c: Candidate, subject: Subject) -> Kind:
    """Return the kind of a candidate; an effect that the model already has counts as a parameter."""
    return "parameter" if c.name in subject.present else c.kind
