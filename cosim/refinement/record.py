"""Content of refine.json, the result of a study for other programs. docs/refine_json.md explains the keys."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from cosim.core.arrays import Array, NamedValues
from cosim.core.text import percent
from cosim.core.version import __version__
from cosim.credibility.bands import Coverage
from cosim.estimation.fit import Fit, expected_values
from cosim.estimation.problem import Noise
from cosim.estimation.subject.candidates import Kind, kind_within
from cosim.estimation.subject.interface import Subject
from cosim.refinement.decision.claims import Claims, text_of
from cosim.refinement.decision.posterior import Grade, Verdict
from cosim.refinement.proof.measure import OTHER_HORIZONS, Floors, Part, Replayed, Replays, rmse
from cosim.refinement.search.fits import Hypothesis
from cosim.refinement.study import Interpolation, Study

Finite = Annotated[float, Field(allow_inf_nan=False)]
Likelihood = Annotated[  # null if the filter has diverged
    Finite | None, BeforeValidator(lambda value: value if value is not None and math.isfinite(value) else None)
]
Channels = Annotated[dict[str, Finite], Field(description="measured output → root mean square, in its SI unit")]
Parts = dict[Part, Channels]


class Estimate(BaseModel):
    """An estimated parameter with its 95 % confidence interval."""

    value: Finite
    unit: str
    ci95: tuple[Finite, Finite]


class EffectEntry(BaseModel):
    """An effect, sensor error or base parameter in the claim; `value` is the parameter of the last two.

    kind: `sensor`: an error of the readings, which model.yaml contains and the FMU does not
    probability: posterior probability that the part belongs to the model
    """

    name: str
    kind: Kind
    parameters: dict[str, Estimate]
    probability: Finite


class NotExcludedEntry(BaseModel):
    """An effect that may replace a claimed effect, which is its special case.

    in_place_of: name of the claimed effect in `effects`
    """

    name: str
    in_place_of: str
    probability: Finite


class ClassEntry(BaseModel):
    """A class of hypotheses that the logs do not distinguish, named by its most probable member."""

    names: list[str]
    probability: Finite


class PerLog(BaseModel):
    """A parameter with a separate value for each group of logs.

    groups: group, or file of a log without a group → estimate
    """

    unit: str
    mean: Finite
    groups: dict[str, Estimate]


class CandidateEntry(BaseModel):
    """A hypothesis that was tried.

    names: added effects, sensor errors and base parameters; empty for the base model
    log_likelihood_gain: gain over the recalibrated model; null if the filter diverged
    score_gain: log posterior odds to the recalibrated model
    parameters: name (`effect.parameter` or base parameter) → value in SI units
    why: `claimed`, `rival, probability N %`, or the reason against the hypothesis
    """

    names: list[str]
    log_likelihood_gain: Likelihood
    score_gain: Likelihood
    fitted: bool
    parameters: dict[str, Finite]
    why: str


class Inputs(BaseModel):
    """How inputs behave between two rows: held or interpolated.

    gain_otherwise: log-likelihood gain if every input is used the other way
    """

    taken: dict[str, Interpolation]
    gain_otherwise: Likelihood


class ProcessNoise(BaseModel):
    """Process noise density of one state's equation, in the state's unit squared per second.

    before: density with the base model
    after: density with the best hypothesis
    inflated: true if the equation is deficient
    gain: log-likelihood gain due to this noise with the best hypothesis
    """

    before: Finite
    after: Finite
    inflated: bool
    gain: Likelihood


class NamelessTerm(BaseModel):
    """A term outside the catalogue that increases the likelihood: coefficient · basis(signal) in one equation.

    equation: state whose derivative has the term
    signal: basis function, such as `v·|v|`; `1` for a constant
    gain: log-likelihood gain due to the term
    coefficient: in the state's unit per second, per unit of the basis
    place: centre of a local shape
    width: width of a local shape
    local: all data of a local shape
    like: law that a local shape resembles
    """

    equation: str
    signal: str
    gain: Finite
    coefficient: Finite
    place: Finite | None = None
    width: Finite | None = None
    local: dict[str, Any] | None = None
    like: str = ""


class Residual(BaseModel):
    """Deficient equation, and signals on which the residual depends, even if nothing in the catalogue explains it.

    signals: signals on which the residual of the equation depends, most important first
    share: share of the missing input's mean square that the first of `terms` explains
    terms: unmodelled dynamics, largest gain first
    changing: parameter that changes with time in each log → its change from the first to the last row, in SI
    """

    equation: str | None
    signals: list[str]
    share: Finite | None
    process_noise: dict[str, ProcessNoise]
    terms: list[NamelessTerm]
    changing: dict[str, Finite] = {}


class RungEntry(BaseModel):
    """Error of one model's predictions of held-out logs, each predicted by a fit to the other logs.

    names: candidates in the model
    ratio: error relative to `before`, geometric mean over outputs and logs
    standard_error: standard error of ln(error / least error of all models), over the logs
    """

    model: Literal["before", "recalibrated", "candidates"]
    names: list[str]
    ratio: Finite
    standard_error: Finite | None


class Errors(BaseModel):
    """RMSE of measured − model in FMU replays, over all logs of a set together.

    before: model named in the study
    recalibrated: this model with adjusted base parameters
    after: model.yaml
    nearest: nearest.yaml (nearest.fmu for an FMU), if there is one
    """

    before: Parts
    recalibrated: Parts
    after: Parts
    nearest: Parts | None = None


class Record(BaseModel):
    """Result of `cosim refine` on a study.

    study: path of the study; empty for a study written in Python
    sentence: verdict in plain words
    posterior: classes of hypotheses, highest probability first
    inclusion: part → probability, the sum over classes that contain it
    dispersion: κ, by which log-likelihoods are divided
    reasons: reasons against a claim
    effects: claimed effects, sensor errors and base parameters, most important first
    rivals: names that the logs do not distinguish, if the verdict is `ambiguous`
    experiment: input that would separate the rivals; empty without rivals
    alike: names with equal predictions for every input
    nearest: names that the nearest model adds to the given model
    ladder: errors on held-out logs, from the given model to models with more candidates
    candidates: all fitted hypotheses, best first
    hidden: effects that these logs would not show at their usual size
    untested: effects that could not be tested with this subject and these logs, with the reasons
    measured: outputs in the estimation logs
    warnings: sentences on what is doubtful about the study
    horizon: duration of the replays in `error` [s]
    horizons: errors over other horizons, in the form of `error`
    noise_floor: noise floor on the validation logs, otherwise on the estimation logs
    noise_floors: error of replays against simulations of the same refined model with noise
    coverage: share of errors on sealed logs within the error bands of the delivered FMU
    seconds: wall time of the refinement [s]
    """

    model_config = ConfigDict(title="refine.json")

    schema_version: Literal[1] = 1
    cosim_version: str = __version__
    study: str
    verdict: Verdict
    sentence: str
    grade: Grade
    posterior: list[ClassEntry]
    inclusion: dict[str, Finite]
    dispersion: Finite
    reasons: list[str]
    finished: Literal[True] = True
    effects: list[EffectEntry]
    rivals: list[str]
    experiment: str
    alike: tuple[tuple[str, ...], ...] = ()
    not_excluded: list[NotExcludedEntry] = []
    nearest: list[str]
    ladder: list[RungEntry]
    per_log: dict[str, PerLog] = {}
    candidates: list[CandidateEntry]
    hidden: list[str]
    untested: list[str] = []
    measured: list[str]
    sensor_noise: Channels
    inputs: Inputs
    warnings: list[str]
    residual: Residual
    replays: Replays
    horizon: Finite | Literal["free run"]
    error: Errors
    horizons: dict[Literal["0.5 s", "free run"], Errors]
    noise_floor: Channels
    noise_floors: Parts
    coverage: Coverage | None = None
    seconds: Finite


def record(
    study: Study,
    claims: Claims,
    sentence: str,
    outputs: Sequence[str],
    *,
    unfitted: Fit,
    noise: Noise,
    gain_otherwise: float,
    played: Replayed,
    floors: Floors,
    way: Replays,
    untested: Sequence[str],
    seconds: float,
) -> Record:
    """Return the content of refine.json.

    Args:
        outputs: Measured outputs.
        unfitted: Given model with fitted parameters per log.
        noise: Noise of the best hypothesis, whose sensor noise does not include model errors.
        gain_otherwise: Log-likelihood gain if every input is used the other way between rows.
        untested: Effects that this study cannot test, with the reasons.
    """
    judged, decision, ramped = study.subject.horizon, claims.decision, study.settings.interpolated
    taken: Any = {q.name: "interpolated" if q.name in ramped else "held" for q in study.subject.inputs}

    def errors(horizon: float) -> Errors:
        return Errors(
            **{name: {part: keep_finite(rmse(e[horizon])) for part, e in of.items()} for name, of in played.items()}
        )

    return Record(
        study=str(study.path or ""),
        verdict=claims.name,
        sentence=sentence,
        grade=claims.grade,
        posterior=[ClassEntry(names=sorted(n), probability=p) for n, p in decision.classes.items()],
        inclusion=dict(decision.inclusion),
        dispersion=decision.dispersion,
        reasons=list(decision.reasons),
        effects=_effects(study.subject, claims),
        rivals=list(claims.rivals),
        experiment=claims.experiment,
        alike=tuple(map(tuple, claims.equivalent)),
        not_excluded=[
            NotExcludedEntry(name=rich, in_place_of=simple, probability=p)
            for (rich, simple), p in decision.not_excluded.items()
        ],
        nearest=list(claims.nearest.names) if claims.nearest else [],
        ladder=_rungs(claims.ladder),
        per_log=_per_log(study, claims.claimed.fit if claims.claimed else unfitted),
        candidates=[
            CandidateEntry(
                names=list(h.names),
                log_likelihood_gain=claims.base.fit.nll - h.fit.nll,
                score_gain=odds,
                fitted=h.fit.iterations > 0,
                parameters=_values(h),
                why=_reason(claims, h, claims.tried[0][1] - odds),
            )
            for h, odds in claims.tried
        ],
        hidden=list(claims.hidden),
        untested=list(untested),
        measured=list(outputs),
        sensor_noise=dict(zip(outputs, np.exp(0.5 * noise.sensors).tolist(), strict=True)),
        inputs=Inputs(taken=taken, gain_otherwise=gain_otherwise),
        warnings=list(study.warnings),
        residual=Residual.model_validate(claims.residual),
        replays=way,
        horizon=judged if math.isfinite(judged) else "free run",
        error=errors(judged),
        horizons={name: errors(horizon) for name, horizon in OTHER_HORIZONS.items()},
        noise_floor=keep_finite(floors["validation" if "validation" in floors else "estimation"]),
        noise_floors={part: keep_finite(floor) for part, floor in floors.items()},
        seconds=seconds,
    )


def unfinished(study: Study, tried: Sequence[Hypothesis]) -> dict[str, Any]:
    """Return the content of refine.json for a study that a time limit has stopped: hypotheses without verdict."""
    base = max((h.fit.nll for h in tried if not h.names), default=math.nan)
    gains = [(h, base - h.fit.nll) for h in sorted(tried, key=lambda h: h.score)]
    candidates = [
        {"names": [*h.names], "log_likelihood_gain": gain if math.isfinite(gain) else None, "parameters": _values(h)}
        for h, gain in gains
    ]
    shared = {"schema_version": 1, "cosim_version": __version__, "study": str(study.path or "")}
    return {**shared, "finished": False, "candidates": candidates}


def keep_finite(channels: NamedValues) -> dict[str, float]:
    """Return the channels with finite values."""
    return {name: value for name, value in channels.items() if math.isfinite(value)}


def _values(h: Hypothesis) -> dict[str, float]:
    return {n: float(h.fit.values[n]) for n in h.parameters}


def _estimate(f: Fit, name: str, unit: str) -> Estimate:
    return Estimate(value=float(f.values[name]), unit=unit, ci95=f.interval(name))


def _effects(subject: Subject, claims: Claims) -> list[EffectEntry]:
    """Return the claimed effects, most probable first."""
    entries = []
    for c in claims.claimed_candidates:
        assert claims.claimed is not None
        fit, units = claims.claimed.fit, {n: subject.declared[n].unit for n in c.parameters}
        parameters = {n.partition(".")[2] or "value": _estimate(fit, n, unit) for n, unit in units.items()}
        chance, kind = claims.decision.claimed[c.name], kind_within(c, subject)
        entries.append(EffectEntry(name=c.name, kind=kind, parameters=parameters, probability=chance))
    return entries


def _per_log(study: Study, f: Fit) -> dict[str, PerLog]:
    """Return the entries in refine.json of the parameters with one value per log."""
    entries, means = {}, expected_values(f)
    for name in study.settings.per_log:
        unit = study.subject.declared[name].unit
        groups = {x.group: _estimate(f, x.name, unit) for x in f.free if x.parameter == name}
        entries[name] = PerLog(unit=unit, mean=means[name][0], groups=groups)
    return entries


def _rungs(ladder: Sequence[tuple[Hypothesis | None, Array]]) -> list[RungEntry]:
    """Return the entries of `ladder`; a model whose predictions diverge is left out."""
    finite = [rung for rung in ladder if np.isfinite(rung[1]).all()]
    if not finite or finite[0][0] is not None:
        return []
    given, least = finite[0][1], min((errors for _, errors in finite), key=lambda errors: float(np.mean(errors)))
    entries = []
    for h, errors in finite:
        model: Any = "before" if h is None else "candidates" if h.candidates else "recalibrated"
        scatter = float(np.std(errors - least, ddof=1) / math.sqrt(errors.size)) if errors.size > 1 else None
        ratio = float(np.exp(np.mean(errors - given)))
        entries.append(RungEntry(model=model, names=list(h.names) if h else [], ratio=ratio, standard_error=scatter))
    return entries


def _reason(claims: Claims, h: Hypothesis, behind: float) -> str:
    """Return `claimed`, `rival, …` or the reason against a hypothesis.

    Args:
        behind: Log odds of the most probable hypothesis relative to this one.
    """
    parts, decision = h.key, claims.decision
    if decision.is_rival(parts):
        return f"rival, probability {percent(decision.rivals[parts - decision.aside])}"
    if claims.claimed is not None and parts == claims.claimed.key and claims.name != "ambiguous":
        return "claimed"
    if parts == decision.nearest:
        return "nothing more is missing" if claims.name == "no_effect" else "most probable, but not claimed"
    if not h.ended:
        return "excluded by a preliminary fit"
    return f"e^{behind:.1f} times less probable than {text_of(claims.tried[0][0].key)}"
