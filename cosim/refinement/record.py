"""Content of refine.json, the result of a study for other programs, with its JSON schema beside this file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field
from pydantic.json_schema import GenerateJsonSchema

from cosim.core.arrays import Array
from cosim.core.text import percent
from cosim.core.version import __version__
from cosim.estimation.fit import Fit
from cosim.estimation.noise_model import Noise
from cosim.estimation.per_log import expected_value, own
from cosim.estimation.subject.candidates import Kind, kind_within
from cosim.estimation.subject.interface import Subject
from cosim.refinement.decision.claims import Claims, text_of
from cosim.refinement.decision.posterior import Grade, Verdict
from cosim.refinement.decision.sentences import Proof, sentence
from cosim.refinement.proof.measure import Floor, ReplayedLogs, rmse
from cosim.refinement.search.hypotheses import Hypothesis
from cosim.refinement.search.input_hold import Between, Way
from cosim.refinement.study import Study
from cosim.residuals.residual_statistics import FREE_RUN

OTHER_HORIZONS: Mapping[Literal["0.5 s", "free run"], float] = {"0.5 s": 0.5, "free run": FREE_RUN}

Finite = Annotated[float, Field(allow_inf_nan=False)]
Likelihood = Annotated[  # null if the filter diverged
    Finite | None, BeforeValidator(lambda value: value if value is not None and math.isfinite(value) else None)
]
Channels = Annotated[dict[str, Finite], Field(description="measured output → root mean square, in its SI unit")]
Part = Literal["estimation", "validation"]
Floors = Mapping[Part, Floor]
Replayed = Mapping[
    str, Mapping[Part, Mapping[float, ReplayedLogs]]
]  # before, recalibrated, after → set of logs → horizon
Parts = dict[Part, Channels]


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True)


class Estimate(_Entry):
    """An estimated parameter."""

    value: Finite
    unit: str
    ci95: tuple[Finite, Finite] = Field(description="bounds of the 95 % confidence interval")


class EffectEntry(_Entry):
    """An effect, sensor error or base parameter in the claim."""

    name: str = Field(description="as in the catalogue; a base parameter by its own name")
    kind: Kind = Field(description="`sensor`: an error of the readings, which model.yaml has and an FMU has not")
    parameters: dict[str, Estimate] = Field(description="by name; base parameters and sensors have one, `value`")
    probability: Finite = Field(description="posterior probability that the part belongs to the model")


class NotExcludedEntry(_Entry):
    """An effect possible in place of a claimed special case."""

    name: str
    in_place_of: str = Field(description="name in `effects`")
    probability: Finite = Field(description="that the richer effect is the true one")


class ClassEntry(_Entry):
    """A class of hypotheses that the logs do not tell apart, named by its most probable member."""

    names: list[str] = Field(description="effects, sensor errors and base parameters; none: the model recalibrated")
    probability: Finite


class Followed(_Entry):
    """A parameter per log on a sealed log without an estimation log in its group, filtered from past data."""

    value: Finite = Field(description="what the filter ended with; in replays, what it knew by then")
    expected: Finite = Field(description="where it starts: the mean over the groups")
    spread: Finite = Field(
        description="standard deviation it starts with: how the groups scatter; where there is one group, by how much "
        "the parameter is usually off"
    )


class PerLog(_Entry):
    """A parameter with a separate value for each group of logs, used with the model in `error.after`."""

    unit: str
    mean: Finite = Field(description="over the groups; what model.yaml has where something is claimed")
    groups: dict[str, Estimate] = Field(description="group, or file of a log that is in none → estimate")
    followed: dict[str, Followed] = Field(description="the same of sealed logs of no known group; never fitted to them")


class CandidateEntry(_Entry):
    """A hypothesis on trial."""

    names: list[str] = Field(description="effects, sensor errors and base parameters it adds; none: the base model")
    log_likelihood_gain: Likelihood = Field(
        description="log-likelihood gained on the base model; null where it diverged"
    )
    score_gain: Likelihood = Field(
        description="log posterior odds to the recalibrated model; of a hypothesis that was only screened an estimate"
    )
    fitted: bool = Field(description="false: the fit was given up before its first step")
    parameters: dict[str, Finite] = Field(description="estimates, `effect.parameter` or base parameter by name, in SI")
    why: str = Field(
        description="why it lost; `claimed` for what is claimed, `a rival: …` for each of `rivals`, for nothing else"
    )


class Inputs(_Entry):
    """Interpolation of inputs between two rows."""

    taken: dict[str, Way] = Field(description="input → `held`, or `interpolated`: straight to the next row")
    gain_otherwise: Likelihood = Field(
        description="log-likelihood, priors included, that the model recalibrated gains where every input is taken the "
        "other way; a warning says so where that is plainly likelier"
    )


class ProcessNoise(_Entry):
    """Process noise density of one state's equation, in the state's unit squared per second."""

    model_config = ConfigDict(extra="allow")

    before: Finite = Field(description="estimated with the base model")
    after: Finite = Field(description="estimated with the best hypothesis")
    inflated: bool = Field(description="still above what counts as none: the equation is deficient")
    gain: Likelihood = Field(
        description="log-likelihood that the noise of this equation gains with the best hypothesis"
    )


class LocalShape(_Entry):
    """Position of a term outside the catalogue: coefficient · factor · shape of one signal."""

    model_config = ConfigDict(extra="allow")

    kind: Literal["bump", "step", "spline"] = Field(description="a spline is a row of bumps")
    of: list[str] = Field(description="the signal that it is over; of two the first less the second")
    place: Finite = Field(description="of the middle, of a spline's first bump")
    width: Finite = Field(description="of a bump at half its height, of a step, of a spline from bump to bump")
    unit: str = Field(description="of place and width")
    turned: bool = Field(description="over an angle that turns: the shape comes back every turn")
    times: list[str] = Field(description="what it is multiplied by, as `of`; empty for nothing")
    dry: bool = Field(description="by the sign of that alone")
    slip: Finite = Field(description="value of that within which the sign turns")
    well: bool = Field(description="it is multiplied by the distance from its place")
    sizes: list[Finite] = Field(description="of its bumps or its step")


class NamelessTerm(_Entry):
    """A term outside the catalogue with a further gain: coefficient · basis of one signal in one equation."""

    model_config = ConfigDict(extra="allow")

    equation: str = Field(description="the state")
    signal: str = Field(
        description="the basis, such as `v·|v|` or `command force`; `1`: a constant; of a local shape what it is over"
    )
    gain: Finite = Field(description="log-likelihood it gains")
    coefficient: Finite = Field(
        description="in the state's unit per second, per unit of the basis; of a spline the largest"
    )
    place: Finite | None = Field(default=None, description="of a local shape: where on its signal it acts")
    width: Finite | None = Field(default=None, description="of a local shape: how wide it is there")
    local: LocalShape | None = Field(default=None, description="the whole of a local shape")
    like: str = Field(default="", description="of a local shape: the law that it resembles, such as dry friction")


class Residual(_Entry):
    """Deficient equation and signals of the misfit, also if nothing in the catalogue fits."""

    model_config = ConfigDict(extra="allow")

    equation: str | None = Field(
        description="the state whose equation is deficient, of a model without states the output; null where none is"
    )
    signals: list[str] = Field(description="what the misfit in that equation depends on, most important first")
    share: Finite | None = Field(
        description="of the mean square of the input that equation lacks, as a smoother estimates it beside the best "
        "hypothesis on the first two logs, what the first of `terms` at its best size takes away beyond what that "
        "hypothesis' own parameters could, 0 … 1; null without a term"
    )
    process_noise: dict[str, ProcessNoise] = Field(description="state → process noise")
    terms: list[NamelessTerm] = Field(
        description="most promising first; of those that the logs do not distinguish the simplest"
    )


class RungEntry(_Entry):
    """Error of predictions of held-out logs by one model, each log predicted by a fit to the others."""

    model: Literal["before", "recalibrated", "candidates"] = Field(
        description="the model of the study, that model recalibrated, or it with the candidates in `names`"
    )
    names: list[str] = Field(description="its candidates")
    ratio: Finite = Field(description="error relative to `before`, geometric mean over outputs and logs")
    standard_error: Finite | None = Field(
        description="standard error over the logs of ln(error / least error of the ladder); null with a single log"
    )


class Errors(_Entry):
    """RMSE of measured − model over FMU replays, pooled over the logs of each set.

    Each replay starts from the replayed model's own filtered state and effect memory, from past data only. A channel
    without any prediction (a log too short for one replay) is omitted.
    """

    before: Parts = Field(description="the model named in the study")
    recalibrated: Parts = Field(description="that model with its base parameters adjusted")
    after: Parts = Field(description="model.yaml")
    nearest: Parts | None = Field(default=None, description="nearest.yaml (for an FMU nearest.fmu), where there is one")


class Replays(_Entry):
    """FMUs used for the replays."""

    through: Literal["native", "python", "own"] = Field(
        description="`native`: the native FMU of the model's class, given each variant's values; `python`: FMUs "
        "that need Python, as plant.fmu does; `own`: the replayer of an object without an FMU"
    )
    why: str = Field(default="", description="why not natively; empty where it was")
    log: str = Field(default="", description="the log that plant.fmu has replayed too")
    apart: Finite | None = Field(
        default=None,
        description="by how much the two differ there, of max(1, largest value of an output); at most 1e-9, or no "
        "replay is native",
    )


IN_PYTHON = Replays(through="python")


class Record(_Entry):
    """Result of `cosim refine` on a study."""

    model_config = ConfigDict(title="refine.json")

    schema_version: Literal[1] = 1
    cosim_version: str = __version__
    study: str = Field(description="path of the study; empty of one that was written in Python")
    verdict: Verdict
    sentence: str = Field(description="the verdict in plain words")
    grade: Grade = Field(
        description="`claimed`; `part`: a claim that leaves more than 10 % of the excess error of replays, or beside "
        "which rivals or significant unnamed terms remain; `nearest`: nothing is claimed"
    )
    posterior: list[ClassEntry] = Field(description="classes of hypotheses with their probabilities, highest first")
    inclusion: dict[str, Finite] = Field(description="part → its probability, the sum over the classes with it")
    dispersion: Finite = Field(
        description="κ, by which log-likelihoods are divided; above 2 a sign that no hypothesis fits"
    )
    reasons: list[str] = Field(description="what stands against a claim")
    finished: Literal[True] = True
    effects: list[EffectEntry] = Field(
        description="what is claimed, most important first; where the verdict is `ambiguous`, the parts that are "
        "certain all the same"
    )
    rivals: list[str] = Field(
        description="what the data cannot distinguish, where the verdict is `ambiguous`; `a + b` are two together; "
        "`no_effect` is the model recalibrated"
    )
    experiment: str = Field(description="the input that would separate rivals, else empty")
    alike: tuple[tuple[str, ...], ...] = Field(
        default=(),
        description="groups of names that act alike for every input, so that no experiment separates them; the first "
        "of each is in `effects` or `rivals`, `a + b` are two together",
    )
    not_excluded: list[NotExcludedEntry] = Field(
        default=[], description="effects in place of claimed ones that are their special cases; the logs do not decide"
    )
    nearest: list[str] = Field(
        description="what the nearest model has more than the given one, where not all is claimed; none where "
        "it is that model, recalibrated or as it was"
    )
    ladder: list[RungEntry] = Field(
        description="errors of predictions of held-out logs, from the model of the study to more and more candidates"
    )
    per_log: dict[str, PerLog] = Field(default={}, description="parameters that the study gives each group of logs")
    candidates: list[CandidateEntry] = Field(description="every hypothesis that was fitted, best first")
    hidden: list[str] = Field(description="effects that these logs would not show at their usual size, and did not")
    measured: list[str] = Field(description="outputs that some estimation log holds")
    sensor_noise: Channels = Field(
        description="standard deviation of the noise of each output in `measured`, as it was taken"
    )
    inputs: Inputs
    warnings: list[str] = Field(description="what is doubtful about the study, in plain words")
    residual: Residual
    replays: Replays = Field(default=IN_PYTHON)
    horizon: Finite | Literal["free run", "row"] = Field(
        description="how long a replay in `error` is [s]: the model's own; `row` of a model without states"
    )
    error: Errors
    horizons: dict[Literal["0.5 s", "free run"], Errors] = Field(
        description="as `error`, over other horizons; empty of a model without states"
    )
    noise_floor: Channels = Field(
        description="as `error.after`, of the refined model against itself, simulated with the estimated process and "
        "sensor noise; on the validation logs where there are any"
    )
    noise_floors: Parts = Field(description="the same for each set of logs")
    floor_scatters: Parts = Field(
        description="standard deviation of the logarithm of each floor from draw to draw; where a floor is above the "
        "error by more than 3 of these and a fifth, a warning says so"
    )
    seconds: Finite = Field(description="time it took")


@dataclass(frozen=True)
class Measurements:
    """Measurements of the proof after all decisions.

    Attributes:
        played: Replays of every variant on every set of logs.
        floors: Noise floor of the errors.
        noise: Noise of the best hypothesis, with sensor noise free of model errors.
        between: Inputs between rows.
        way: FMUs used for the replays.
        ends: Final filtered values of parameters per log on sealed logs.
        seconds: Duration of the study.
    """

    played: Replayed
    floors: Floors
    noise: Noise
    between: Between
    way: Replays = IN_PYTHON
    ends: Mapping[str, float] = field(default_factory=dict)
    seconds: float = 0.0


def record(
    study: Study, claims: Claims, told: Proof, unfitted: Fit, measured: Sequence[str], proof: Measurements
) -> Record:
    """Return the content of refine.json.

    Args:
        unfitted: Given model with fitted parameters per log.
    """
    judged = study.subject.horizon
    claimed, floors, sets = claims.claimed, proof.floors, proof.played.items()

    def errors(horizon: float) -> Errors:
        return Errors(
            **{name: {part: keep_finite(rmse(e[horizon])) for part, e in parts.items()} for name, parts in sets}
        )

    return Record(
        study=str(study.path or ""),
        verdict=claims.name,
        sentence=sentence(claims, study.subject, told),
        grade=claims.grade,
        posterior=[ClassEntry(names=sorted(n), probability=p) for n, p in claims.decision.classes.items()],
        inclusion=dict(claims.decision.inclusion),
        dispersion=claims.decision.dispersion,
        reasons=list(claims.decision.reasons),
        effects=effects(study.subject, claims),
        rivals=list(claims.rivals),
        experiment=claims.experiment,
        alike=tuple(map(tuple, claims.equivalent)),
        not_excluded=[
            NotExcludedEntry(name=rich, in_place_of=simple, probability=p)
            for (rich, simple), p in claims.decision.not_excluded.items()
        ],
        nearest=list(claims.nearest.names) if claims.nearest else [],
        ladder=_rungs(claims.ladder),
        per_log=per_log(study, claimed.fit if claimed else unfitted, proof.ends),
        candidates=[
            CandidateEntry(
                names=list(h.names),
                log_likelihood_gain=claims.base.fit.nll - h.fit.nll,
                score_gain=odds,
                fitted=h.fit.iterations > 0,
                parameters={n: float(h.fit.values[n]) for c in h.candidates for n in c.parameters},
                why=_reason(claims, h, claims.tried[0][1] - odds),
            )
            for h, odds in claims.tried
        ],
        hidden=list(claims.hidden),
        measured=list(measured),
        sensor_noise=dict(zip(measured, np.exp(0.5 * proof.noise.sensors).tolist(), strict=True)),
        inputs=Inputs(taken=dict(proof.between.ways), gain_otherwise=proof.between.gain),
        warnings=list(study.warnings),
        residual=Residual.model_validate(claims.residual),
        replays=proof.way,
        horizon=judged if math.isfinite(judged) else "free run",
        error=errors(judged),
        horizons={name: errors(horizon) for name, horizon in OTHER_HORIZONS.items()},
        noise_floor=keep_finite(floors["validation" if "validation" in floors else "estimation"].level),
        noise_floors={part: keep_finite(floor.level) for part, floor in floors.items()},
        floor_scatters={part: keep_finite(floor.scatter) for part, floor in floors.items()},
        seconds=proof.seconds,
    )


def unfinished(study: Study, tried: Sequence[Hypothesis]) -> dict[str, Any]:
    """Return the content of refine.json of a study that its limit of time has stopped: hypotheses, and no verdict."""
    base = max((h.fit.nll for h in tried if not h.names), default=math.nan)
    candidates = [
        {
            "names": list(h.names),
            "log_likelihood_gain": base - h.fit.nll if math.isfinite(base - h.fit.nll) else None,
            "parameters": {n: float(h.fit.values[n]) for c in h.candidates for n in c.parameters},
        }
        for h in sorted(tried, key=lambda h: h.score)
    ]
    shared = {"schema_version": 1, "cosim_version": __version__, "study": str(study.path or "")}
    return {**shared, "finished": False, "candidates": candidates}


def _rungs(ladder: Sequence[tuple[Hypothesis | None, Array]]) -> list[RungEntry]:
    """Return the entries of the ladder; a model whose predictions diverge is omitted."""
    finite = [rung for rung in ladder if np.isfinite(rung[1]).all()]
    if not finite or finite[0][0] is not None:
        return []
    given, least = finite[0][1], min((errors for _, errors in finite), key=lambda errors: float(np.mean(errors)))
    entries = []
    for h, errors in finite:
        excess = errors - least
        model: Literal["before", "recalibrated", "candidates"] = (
            "before" if h is None else "candidates" if h.candidates else "recalibrated"
        )
        scatter = float(np.std(excess, ddof=1) / math.sqrt(excess.size)) if excess.size > 1 else None
        ratio = float(np.exp(np.mean(errors - given)))
        entries.append(RungEntry(model=model, names=list(h.names) if h else [], ratio=ratio, standard_error=scatter))
    return entries


class _Untitled(GenerateJsonSchema):
    """Schema generator without titles, which would only repeat the keys."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def schema() -> dict[str, Any]:
    """Return the JSON schema of refine.json."""
    body = Record.model_json_schema(mode="serialization", schema_generator=_Untitled)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **body}


def keep_finite(channels: Mapping[str, float]) -> dict[str, float]:
    """Return the channels with finite values."""
    return {name: value for name, value in channels.items() if math.isfinite(value)}


def effects(subject: Subject, claims: Claims) -> list[EffectEntry]:
    """Return the claimed effects, most probable first."""
    claimed, declared = claims.claimed, subject.declared
    return [
        EffectEntry(
            name=c.name,
            kind=kind_within(c, subject),
            parameters={
                n.partition(".")[2] or "value": _estimate(claimed.fit, n, declared[n].unit) for n in c.parameters
            },
            probability=claims.decision.claimed[c.name],
        )
        for c in claims.claimed_candidates
        if claimed is not None
    ]


def per_log(study: Study, f: Fit, ends: Mapping[str, float]) -> dict[str, PerLog]:
    """Return the entry of every parameter per log."""
    declared, entries = study.subject.declared, {}
    for name in study.settings.per_log:
        unit, (mean, sd) = declared[name].unit, expected_value(f, name)
        groups = {x.group: _estimate(f, x.name, unit) for x in f.free if x.parameter == name}
        sealed = dict.fromkeys(g for g in study.settings.groups.values() if g not in groups)
        followed = {g: Followed(value=ends[own(name, g)], expected=mean, spread=sd) for g in sealed}
        entries[name] = PerLog(unit=unit, mean=mean, groups=groups, followed=followed)
    return entries


def _estimate(f: Fit, name: str, unit: str) -> Estimate:
    return Estimate(value=float(f.values[name]), unit=unit, ci95=f.interval(name))


def _reason(claims: Claims, h: Hypothesis, behind: float) -> str:
    """Return the reason against a hypothesis.

    Args:
        behind: Log odds of the most probable hypothesis to it.
    """
    parts, decision = frozenset(h.names), claims.decision
    if decision.is_rival(parts):
        return f"a rival: probability {percent(decision.rivals[parts - decision.aside])}"
    if claims.claimed is not None and h.names == claims.claimed.names and claims.name != "ambiguous":
        return "claimed"
    if parts == decision.nearest:
        return "nothing more is missing" if claims.name == "no_effect" else "most probable, but not claimed"
    if not h.ended:
        return "screened: the logs speak against it"
    return f"e^{behind:.1f} times less probable than {text_of(frozenset(claims.tried[0][0].names))}"
