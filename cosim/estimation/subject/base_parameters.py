"""Base parameters of a subject, recalibrated near their data sheet values."""

from __future__ import annotations

from collections.abc import Mapping

from cosim.estimation.subject.candidates import Candidate, Free, Kind
from cosim.estimation.subject.interface import Subject
from cosim.model.quantities import Parameter

# default relative tolerance of a data sheet value, valid in 95 of 100 cases; recalibration within is no finding
TOLERANCE = 0.02
WIDTHS = 2.0  # standard deviations in a tolerance on each side


def base_parameters(subject: Subject, values: Mapping[str, float], tolerance: Mapping[str, float]) -> list[Free]:
    """Return base parameters free in every fit, with priors.

    Args:
        tolerance: Parameter → relative tolerance from the study; overrides the model's tolerance.
    """
    stated = {p.name: p.tolerance for p in subject.parameters if p.tolerance is not None} | dict(tolerance)
    every = {**{name: stated.get(name, TOLERANCE) for name in subject.calibrated}, **stated}
    return [base_parameter(subject, name, values, share) for name, share in every.items()]


def base_parameter(subject: Subject, name: str, values: Mapping[str, float], tolerance: float | None) -> Free:
    """Return a base parameter as a free parameter of a fit, with a prior if a tolerance is stated."""
    p, value = subject.declared[name], values[name]
    prior = None if tolerance is None else (value, spread_of_base(p, value, tolerance))
    return Free(name, *p.bounds, 0.05 * _scale(p, value), prior)


def spread_of_base(p: Parameter, value: float, tolerance: float) -> float:
    """Return the prior standard deviation of a base parameter."""
    return tolerance * _scale(p, value) / WIDTHS


def _scale(p: Parameter, value: float) -> float:
    return abs(value) or p.typical or abs(float(p.default)) or 0.01 * (p.bounds[1] - p.bounds[0])


def kind_within(c: Candidate, subject: Subject) -> Kind:
    """Return the kind of a candidate; an effect already in the model counts as a parameter."""
    return "parameter" if c.name in subject.present else c.kind
