"""What may be missing or wrong: every effect of the catalogue, every sensor error, every base parameter."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from cosim.model.model import Model
from cosim.model.quantities import Parameter, parameters_of

Kind = Literal["effect", "sensor", "parameter"]
# A data sheet that states no tolerance is taken to be right to this share, in 95 cases of 100: recalibration within it
# is no discovery.
TOLERANCE = 0.02
WIDTHS = 2.0  # standard deviations to a tolerance on each side


@dataclass(frozen=True)
class Candidate:
    """A hypothesis: its free parameters and the values from which its fit starts."""

    name: str
    kind: Kind
    free: tuple[Free, ...]
    starts: tuple[Mapping[str, float], ...]

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of its parameters."""
        return tuple(f.name for f in self.free)


def neutral_values(model: Model) -> dict[str, float]:
    """Every number the kernel takes: base parameters, effects as the model has them, sensors without error."""
    own = {p.name: getattr(model, p.name) for p in model.parameters}
    own |= {f"{e.name}.{p.name}": getattr(e, p.name) for e in model.effects for p in parameters_of(e)}
    declared = model.declared | model.sensor_parameters
    switches = {p.name for p in model.parameters if isinstance(p.default, bool)}
    return {name: float(own.get(name, p.default)) for name, p in declared.items() if name not in switches}


def base_parameters(model: Model, values: Mapping[str, float], tolerance: Mapping[str, float]) -> list[Free]:
    """The parameters every fit recalibrates, each held near its data sheet: the calibrated, and those with a tolerance.

    tolerance: parameter → share of it, as the study states it; before what the model states
    """
    stated = tolerances(model, tolerance)
    return [_base(model, name, values, share) for name, share in stated.items()]


def tolerances(model: Model, tolerance: Mapping[str, float]) -> dict[str, float]:
    """Base parameter → its tolerance, of those that every fit recalibrates."""
    stated = {p.name: p.tolerance for p in model.parameters if p.tolerance is not None} | dict(tolerance)
    return {**{name: stated.get(name, TOLERANCE) for name in model.calibrated}, **stated}


def candidates(model: Model, values: Mapping[str, float], varied: Sequence[str]) -> list[Candidate]:
    """All of them; a suspect parameter only where the inputs it needs are varied in the logs."""
    return [*_effects(model, values), *_parameters(model, values, varied)]


def _effects(model: Model, values: Mapping[str, float]) -> Iterator[Candidate]:
    for kind in (*model.catalogue, *model.sensors):
        declared = parameters_of(kind)
        names = [f"{kind.name}.{p.name}" for p in declared]
        above = {f"{kind.name}.{p}": f"{kind.name}.{other}" for p, other in kind.at_least.items()}
        free = tuple(_free(p, name, above.get(name, "")) for p, name in zip(declared, names, strict=True))
        here = {name: values[name] for name in names}
        first = {name: _start(p, values[name]) for p, name in zip(declared, names, strict=True)}
        starts = [first, *({f"{kind.name}.{name}": value for name, value in s.items()} for s in kind.starts)]
        if any(type(e) is kind for e in model.awake):
            starts = [here]  # the model has this effect already: it is recalibrated
        yield Candidate(kind.name, "sensor" if kind in model.sensors else "effect", free, tuple(starts))


def _parameters(model: Model, values: Mapping[str, float], varied: Sequence[str]) -> Iterator[Candidate]:
    suspects = [name for name, inputs in model.suspect.items() if any(i in varied for i in inputs)]
    for name in (*model.calibrated, *suspects):
        yield Candidate(name, "parameter", (_base(model, name, values, None),), ({name: values[name]},))


def _base(model: Model, name: str, values: Mapping[str, float], tolerance: float | None) -> Free:
    """A base parameter within its bounds; its size is that of its value, of one that is 0 its usual size."""
    p, value = model.declared[name], values[name]
    prior = None if tolerance is None else (value, spread_of_base(p, value, tolerance))
    return Free(name, *p.bounds, 0.05 * _scale(p, value), prior)


def spread_of_base(p: Parameter, value: float, tolerance: float) -> float:
    """Standard deviation of a base parameter about its value, of its tolerance."""
    return tolerance * _scale(p, value) / WIDTHS


def _scale(p: Parameter, value: float) -> float:
    return abs(value) or p.typical or abs(float(p.default)) or 0.01 * (p.bounds[1] - p.bounds[0])


def usual_size(p: Parameter) -> float:
    """By which it is usually off, or met."""
    return p.typical or 0.3 * abs(float(p.default)) or 0.1


def _free(p: Parameter, name: str, above: str) -> Free:
    return Free(name, *p.bounds, usual_size(p), neutral=p.neutral, above=above)


def _start(p: Parameter, value: float) -> float:
    """One-sided parameters start at a size that is detected, two-sided ones at neutral, between the signs."""
    one_sided = p.neutral is not None and p.neutral == p.bounds[0]
    return p.typical if one_sided and p.typical else value


def kind_within(c: Candidate, model: Model) -> Kind:
    """The kind of a candidate; an effect that the model has already is one more parameter of it."""
    return "parameter" if c.name in {e.name for e in model.awake} else c.kind


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
