"""Content of fit.json, the result of a fit for other programs, with its JSON schema beside this file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from pydantic.json_schema import GenerateJsonSchema

from cosim.calibration.estimate import Estimate
from cosim.calibration.replay_proof import Part
from cosim.calibration.vary import Parameter
from cosim.core.version import __version__
from cosim.residuals.residual_statistics import FREE_RUN, remaining_excess

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
    logs: Sequence[Path]
    sealed: Sequence[Path]
    estimate: Estimate
    given: Mapping[str, Any]
    parts: Sequence[Part]
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
    likelihood, point = estimate.best
    alone = {n for c in estimate.combinations for n in c.names}
    entries = {}

    def add(p: Parameter, value: float, half: float, status: Any) -> None:
        entries[p.name] = ParameterEntry(
            value=value,
            unit=p.unit,
            start=p.start,
            low=_finite(p.low),
            high=_finite(p.high),
            tolerance=p.tolerance,
            ci95=_interval(value, half),
            status=status,
        )

    for j, unknown in enumerate(likelihood.unknowns):
        if unknown.log is None:
            p, value = unknown.parameter, float(point.x[j])
            half = math.nan if p.name in alone else _half(estimate, j)
            add(p, value, half, "at_bound" if value in (p.low, p.high) else "estimated")
    for held in estimate.held.values():
        add(held, held.start, math.nan, "held")
    return entries


def _half(estimate: Estimate, j: int) -> float:
    return math.nan if estimate.covariance is None else estimate.covariance.half(j)


def _interval(value: float, half: float) -> tuple[float, float] | None:
    return (value - half, value + half) if math.isfinite(half) else None


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def record(fitted: Outcome, sentence: str, seconds: float, warnings: Sequence[str], notes: Sequence[str]) -> Record:
    """Return the content of fit.json."""
    estimate = fitted.estimate
    likelihood, point = estimate.best
    channels, spread = estimate.logs.channels, estimate.covariance
    colour = [math.nan] * len(channels) if spread is None else spread.colour.tolist()
    sigmas = zip(channels, point.sigma.tolist(), colour, strict=True)
    correlation = None
    if spread is not None:
        shared = [j for j, u in enumerate(likelihood.unknowns) if u.log is None]
        matrix = spread.matrix[np.ix_(shared, shared)]
        roots = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        correlation = np.clip(matrix / np.outer(roots, roots), -1.0, 1.0).tolist()
    starts = [
        StartEntry(
            log=str(estimate.logs.drives[u.log].log.path),
            name=u.name,
            value=value,
            unit=u.parameter.unit,
            ci95=_interval(value, _half(estimate, j)),
            named=u.hidden,
        )
        for j, (u, value) in enumerate(zip(likelihood.unknowns, point.x.tolist(), strict=True))
        if u.log is not None
    ]
    errors = {}
    for part in fitted.parts:
        units = {n: u for r in part.after for n, u in r.log.units.items()}
        decisive = {
            name: ChannelErrors(
                unit=units[name],
                before=_finite(before),
                after=_finite(after),
                noise_floor=_finite(part.floor.get(name, math.nan)),
                excess_left=_finite(remaining_excess(before, after, part.floor.get(name, 0.0))),
            )
            for name, (before, after) in part.errors(part.horizon).items()
        }
        common = set.intersection(*(set(r.replays) for r in (*part.before, *part.after)))
        horizons = {
            "free run" if h == FREE_RUN else f"{h:g} s": {
                n: (_finite(a), _finite(b)) for n, (a, b) in part.errors(h).items()
            }
            for h in sorted(common, key=lambda h: (h != part.horizon, h))
        }
        errors["sealed" if part.sealed else "estimation"] = PartErrors(
            horizon=_finite(part.horizon), channels=decisive, horizons=horizons
        )
    return Record(
        fmu=str(fitted.fmu),
        logs=[str(p) for p in fitted.logs],
        sealed=[str(p) for p in fitted.sealed],
        verdict=fitted.verdict,
        sentence=sentence,
        windows=estimate.logs.horizon,
        windows_reason=estimate.reason,
        parameters=dict(fitted.parameters),
        starts=starts,
        given=dict(fitted.given),
        correlation=correlation,
        singular_values=estimate.singular.tolist(),
        combinations=[CombinationEntry(**{**asdict(c), "names": list(c.names)}) for c in estimate.combinations],
        screening=[ChoiceEntry(**{**c._asdict(), "effect": _finite(c.effect)}) for c in estimate.screened],
        noise={n: NoiseEntry(sigma=s, colour=_finite(c)) for n, s, c in sigmas},
        errors=errors,
        simulations=estimate.logs.count,
        failed_simulations=estimate.logs.failed,
        seconds=seconds,
        warnings=list(warnings),
        notes=list(notes),
    )
