"""Own parameters of a subject that fits recalibrate, each held near its data sheet."""

from __future__ import annotations

from collections.abc import Mapping

from cosim.model.quantities import Parameter
from cosim.subject.candidates import Candidate, Free, Kind
from cosim.subject.interface import Subject

# A data sheet that states no tolerance is taken to be right to this share, in 95 cases of 100: recalibration within it
# is no discovery.
TOLERANCE = 0.02
WIDTHS = 2.0  # standard deviations to a tolerance on each side


def base_parameters(subject: Subject, values: Mapping[str, float], tolerance: Mapping[str, float]) -> list[Free]:
    """The parameters every fit recalibrates, each held near its data sheet: the calibrated, and those with a tolerance.

    tolerance: parameter → share of it, as the study states it; before what the model states
    """
    stated = tolerances(subject, tolerance)
    return [base_parameter(subject, name, values, share) for name, share in stated.items()]


def tolerances(subject: Subject, tolerance: Mapping[str, float]) -> dict[str, float]:
    """Base parameter → its tolerance, of those that every fit recalibrates."""
    stated = {p.name: p.tolerance for p in subject.parameters if p.tolerance is not None} | dict(tolerance)
    return {**{name: stated.get(name, TOLERANCE) for name in subject.calibrated}, **stated}


def base_parameter(subject: Subject, name: str, values: Mapping[str, float], tolerance: float | None) -> Free:
    """A base parameter within its bounds; its size is that of its value, of one that is 0 its usual size."""
    p, value = subject.declared[name], values[name]
    prior = None if tolerance is None else (value, spread_of_base(p, value, tolerance))
    return Free(name, *p.bounds, 0.05 * _scale(p, value), prior)


def spread_of_base(p: Parameter, value: float, tolerance: float) -> float:
    """Standard deviation of a base parameter about its value, of its tolerance."""
    return tolerance * _scale(p, value) / WIDTHS


def _scale(p: Parameter, value: float) -> float:
    return abs(value) or p.typical or abs(float(p.default)) or 0.01 * (p.bounds[1] - p.bounds[0])


def kind_within(c: Candidate, subject: Subject) -> Kind:
    """The kind of a candidate; an effect that the model has already is one more parameter of it."""
    return "parameter" if c.name in subject.present else c.kind
