"""Content of fit.json, the result of a fit for other programs, with its JSON schema beside this file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from pydantic.json_schema import GenerateJsonSchema

from cosim.base.arrays import Array
from cosim.base.version import __version__
from cosim.calibration.estimate import Estimate
from cosim.calibration.replay_proof import Part
from cosim.residuals.residual_statistics import FREE_RUN

Finite = Annotated[float, Field(allow_inf_nan=False)]
Verdict = Literal["improved", "unchanged", "worse", "stopped"]
CLEAR = 0.95  # ratio of errors from which the model is better


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True)


class ParameterEntry(_Entry):
    """A parameter that all logs share."""

    value: Finite
    unit: str
    start: Finite = Field(description="value before the fit")
    low: Finite | None = Field(description="bound, null without one")
    high: Finite | None
    tolerance: Finite | None = Field(description="half-width of the 95 % interval of a prior about start; null: none")
    ci95: tuple[Finite, Finite] | None = Field(description="95 % confidence interval; null if not identifiable alone")
    status: Literal["estimated", "at_bound", "held"] = Field(
        description="held: kept at start, see combinations, or without effect"
    )


class StartEntry(_Entry):
    """A start value of one log."""

    log: str
    name: str
    value: Finite
    unit: str
    ci95: tuple[Finite, Finite] | None
    named: bool = Field(description="true: named by the user; false: shown by a measured output")


class ChoiceEntry(_Entry):
    """A screened parameter."""

    name: str
    effect: Finite | None = Field(description="effect of a change by 10 %, in standard deviations of the noise")
    estimated: bool
    reason: str


class CombinationEntry(_Entry):
    """Parameters of which the logs determine one combination only."""

    names: list[str]
    held: str
    form: Literal["ratio", "product", "sum", "difference", "combination"]
    expression: str


class ChannelErrors(_Entry):
    """Root mean square errors of an output over the decisive horizon."""

    unit: str
    before: Finite | None
    after: Finite | None
    noise_floor: Finite | None = Field(description="of the fitted model against itself, with the noise of the log")
    excess_left: Finite | None = Field(description="share of the mean square error above the floor that remains")


class PartErrors(_Entry):
    """Errors on a set of logs, by the replays of `cosim replay`."""

    horizon: Finite | None = Field(description="decisive horizon [s], null for free runs")
    channels: dict[str, ChannelErrors]
    horizons: dict[str, dict[str, tuple[Finite | None, Finite | None]]] = Field(
        description="horizon → output → errors before and after"
    )


class NoiseEntry(_Entry):
    """Residual of an output after the fit."""

    sigma: Finite = Field(description="standard deviation")
    colour: Finite | None = Field(description="variance of its mean relative to white noise; 1 for white noise")


class Record(_Entry):
    """Result of a fit."""

    schema_version: Literal[1] = 1
    version: str = __version__
    fmu: str
    logs: list[str]
    sealed: list[str]
    verdict: Verdict
    sentence: str
    windows: Finite | None = Field(description="length of the windows of the estimate [s]; null for free runs")
    windows_reason: str
    parameters: dict[str, ParameterEntry]
    starts: list[StartEntry]
    given: dict[str, Any] = Field(description="further values set by --start")
    correlation: list[list[Finite]] | None = Field(description="of the estimated parameters, in their order")
    singular_values: list[Finite] = Field(description="of the sensitivities per value, in standard deviations")
    combinations: list[CombinationEntry]
    screening: list[ChoiceEntry]
    noise: dict[str, NoiseEntry]
    errors: dict[Literal["estimation", "sealed"], PartErrors]
    simulations: int = Field(description="runs over a whole log until the estimate, failed ones included")
    failed_simulations: int
    seconds: Finite
    warnings: list[str]
    notes: list[str]


class _Untitled(GenerateJsonSchema):
    """Schema generator without titles, which would only repeat the keys."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def schema() -> dict[str, Any]:
    """Return the JSON schema of fit.json."""
    body = Record.model_json_schema(mode="serialization", schema_generator=_Untitled)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **body}


@dataclass(frozen=True, eq=False)
class Outcome:
    """A fit with everything that its files show.

    Attributes:
        given: Values of `--start`.
        parts: Errors on the logs of the estimate, then on sealed logs; empty for a stopped fit.
        risen: Outputs whose error rises significantly on sealed logs.
        parameters: Entries by name, as in the record.
    """

    fmu: Path
    logs: tuple[Path, ...]
    sealed: tuple[Path, ...]
    estimate: Estimate
    given: Mapping[str, Any]
    parts: tuple[Part, ...]
    risen: tuple[str, ...]
    parameters: Mapping[str, ParameterEntry]

    @property
    def decisive(self) -> Part | None:
        """Return the sealed logs, or those of the estimate without any."""
        return self.parts[-1] if self.parts else None

    @property
    def verdict(self) -> Verdict:
        """Return the verdict, by the geometric mean of the error ratios."""
        if self.decisive is None:
            return "stopped"
        ratio = self.decisive.ratio
        if self.risen or ratio > 1.0 / CLEAR:
            return "worse"
        return "improved" if ratio < CLEAR else "unchanged"


def parameter_entries(estimate: Estimate) -> dict[str, ParameterEntry]:
    """Return the entries of the parameters that all logs share, held ones last."""
    likelihood, point, matrix = estimate.likelihood, estimate.point, estimate.covariance
    assert likelihood is not None
    assert point is not None
    alone = {n for c in estimate.combinations for n in c.names}
    entries = {}
    for j, unknown in enumerate(likelihood.unknowns):
        p, value = unknown.parameter, float(point.x[j])
        if unknown.log is not None:
            continue
        at_bound = value in (p.low, p.high)
        half = None if matrix is None or p.name in alone else matrix.half(j)
        entries[p.name] = _parameter_entry(p, value, half, "at_bound" if at_bound else "estimated")
    for name, held in estimate.held.items():
        entries[name] = _parameter_entry(held, held.start, None, "held")
    return entries


def _parameter_entry(p: Any, value: float, half: float | None, status: Any) -> ParameterEntry:
    return ParameterEntry(
        value=value,
        unit=p.unit,
        start=p.start,
        low=_finite(p.low),
        high=_finite(p.high),
        tolerance=p.tolerance,
        ci95=_interval(value, half),
        status=status,
    )


def _interval(value: float, half: float | None) -> tuple[float, float] | None:
    return None if half is None or not math.isfinite(half) else (value - half, value + half)


def _starts(estimate: Estimate) -> Iterator[StartEntry]:
    likelihood, point, matrix = estimate.likelihood, estimate.point, estimate.covariance
    assert likelihood is not None
    assert point is not None
    for j, unknown in enumerate(likelihood.unknowns):
        if unknown.log is not None:
            value, p = float(point.x[j]), unknown.parameter
            ci95 = _interval(value, None if matrix is None else matrix.half(j))
            log = str(estimate.logs.drives[unknown.log].log.path)
            yield StartEntry(log=log, name=p.name, value=value, unit=p.unit, ci95=ci95, named=unknown.hidden)


def record(fitted: Outcome, sentence: str, seconds: float, warnings: Sequence[str], notes: Sequence[str]) -> Record:
    """Return the content of fit.json."""
    estimate = fitted.estimate
    point = estimate.point
    assert point is not None
    channels = estimate.logs.channels
    colour = np.full(len(channels), np.nan) if estimate.covariance is None else estimate.covariance.colour
    sigmas = zip(channels, point.residuals.sigma.tolist(), colour.tolist(), strict=True)
    names = {False: "estimation", True: "sealed"}
    return Record(
        fmu=str(fitted.fmu),
        logs=[str(p) for p in fitted.logs],
        sealed=[str(p) for p in fitted.sealed],
        verdict=fitted.verdict,
        sentence=sentence,
        windows=estimate.logs.horizon,
        windows_reason=estimate.reason,
        parameters=dict(fitted.parameters),
        starts=list(_starts(estimate)),
        given=dict(fitted.given),
        correlation=None if estimate.covariance is None else correlation(estimate).tolist(),
        singular_values=estimate.singular.tolist(),
        combinations=[
            CombinationEntry(names=list(c.names), held=c.held, form=c.form, expression=c.expression)
            for c in estimate.combinations
        ],
        screening=[
            ChoiceEntry(name=c.name, effect=_finite(c.effect), estimated=c.estimated, reason=c.reason)
            for c in estimate.screened
        ],
        noise={n: NoiseEntry(sigma=s, colour=_finite(c)) for n, s, c in sigmas},
        errors={names[p.sealed]: _part_errors(p) for p in fitted.parts},
        simulations=estimate.logs.count,
        failed_simulations=estimate.logs.failed,
        seconds=seconds,
        warnings=list(warnings),
        notes=list(notes),
    )


def correlation(estimate: Estimate) -> Array:
    """Return the correlation matrix of the estimated parameters."""
    assert estimate.covariance is not None
    assert estimate.likelihood is not None
    shared = [j for j, u in enumerate(estimate.likelihood.unknowns) if u.log is None]
    matrix = estimate.covariance.matrix[np.ix_(shared, shared)]
    roots = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return np.asarray(np.clip(matrix / np.outer(roots, roots), -1.0, 1.0))


def _part_errors(part: Part) -> PartErrors:
    units = {n: u for r in part.after for n, u in r.log.units.items()}
    floor = part.floor
    channels = {
        name: ChannelErrors(
            unit=units[name],
            before=_finite(before),
            after=_finite(after),
            noise_floor=_finite(floor.get(name, math.nan)),
            excess_left=_finite(part.excess(name)),
        )
        for name, (before, after) in part.errors(part.horizon).items()
    }
    horizons = {
        "free run" if h == FREE_RUN else f"{h:g} s": {
            n: (_finite(a), _finite(b)) for n, (a, b) in part.errors(h).items()
        }
        for h in part.horizons
    }
    return PartErrors(horizon=_finite(part.horizon), channels=channels, horizons=horizons)


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
