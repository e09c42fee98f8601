"""Content of refine.json, the result of a study for other programs, with its JSON schema beside this file."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field
from pydantic.json_schema import GenerateJsonSchema

from cosim.core.text import join_names
from cosim.core.version import __version__
from cosim.estimation.expected import expected_value
from cosim.estimation.fit import Fit
from cosim.estimation.noise_model import Noise
from cosim.estimation.per_log import own
from cosim.estimation.problem import Problem
from cosim.estimation.subject.candidates import Candidate, Kind, kind_within
from cosim.estimation.subject.interface import Subject
from cosim.refinement.decision.claims import Claims, Grade, Name, Rung
from cosim.refinement.decision.sentences import sentence
from cosim.refinement.proof.measure import Evidence, Floor, rmse
from cosim.refinement.search.hypotheses import TOGETHER, Attribution, Hypothesis
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
Replayed = Mapping[str, Mapping[Part, Mapping[float, Evidence]]]  # before, recalibrated, after → set of logs → horizon
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


class NotExcludedEntry(_Entry):
    """An effect possible in place of a claimed special case."""

    name: str
    in_place_of: str = Field(description="name in `effects`")
    parameter: str = Field(description="in which both differ")
    up_to: Finite = Field(description="largest value in its 95 % interval")
    unit: str


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
        description="the same less the penalty of the base parameters' priors, less ½ ln N for each parameter added "
        "(half of BIC) and, for each candidate, 3 and the logarithm of how many are on trial"
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
    verdict: Name
    sentence: str = Field(description="the verdict in plain words")
    grade: Grade = Field(
        description="`claimed`; `part`: a claim that leaves more than 10 % of the excess error, or half of it on a "
        "channel of the sealed logs, or an unknown input of more than 2 % of the derivative of its state; `nearest`: "
        "nothing is claimed for sure; the nearest model predicts best"
    )
    every_rival_misses: dict[str, Finite] = Field(
        default={},
        description="where every rival of an `ambiguous` verdict leaves an output of the sealed logs at more than "
        "twice the noise floor: the output that the best rival misses most → its multiple of the floor; else empty",
    )
    effects: list[EffectEntry] = Field(
        description="what is claimed, most important first; where the verdict is `ambiguous`, what all rivals contain, "
        "with intervals over all of them"
    )
    rivals: list[str] = Field(
        description="what the data cannot distinguish, where the verdict is `ambiguous`; `a + b` are two together"
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
    held_out_gain: Likelihood = Field(
        description="log-likelihood that the claim gains on each log, as the other logs have it"
    )
    seconds: Finite = Field(description="time it took")


@dataclass(frozen=True)
class Measurements:
    """Measurements of the proof after all decisions.

    Attributes:
        played: Replays of every variant on every set of logs.
        floors: Noise floor of the errors.
        noise: Noise of the best hypothesis, with sensor noise free of model errors.
        way: FMUs used for the replays.
        ends: Final filtered values of parameters per log on sealed logs.
        seconds: Duration of the study.
    """

    played: Replayed
    floors: Floors
    noise: Noise
    way: Replays = IN_PYTHON
    ends: Mapping[str, float] = field(default_factory=dict)
    seconds: float = 0.0


def _not_excluded(claims: Claims) -> list[NotExcludedEntry]:
    return [NotExcludedEntry.model_validate(asdict(other)) for other in claims.not_excluded]


def record(
    study: Study, a: Attribution, claims: Claims, problem: Problem, between: Between, proof: Measurements
) -> Record:
    """Return the content of refine.json."""
    judged = study.subject.horizon
    claimed, floors, sets = claims.claimed, proof.floors, proof.played.items()

    def errors(horizon: float) -> Errors:
        return Errors(
            **{name: {part: keep_finite(rmse(e[horizon])) for part, e in parts.items()} for name, parts in sets}
        )

    return Record(
        study=str(study.path or ""),
        verdict=claims.name,
        sentence=sentence(claims, study.subject),
        grade=claims.grade,
        every_rival_misses=dict(claims.missed),
        effects=effects(study.subject, claimed, a.tried, claims.claimed_candidates) if claimed else [],
        rivals=list(claims.rivals) if claims.name == "ambiguous" else [],
        experiment=claims.experiment,
        alike=claims.namesakes,
        not_excluded=_not_excluded(claims),
        nearest=list(claims.nearest.names) if claims.nearest else [],
        ladder=_rungs(claims.ladder),
        per_log=per_log(study, claimed.fit if claimed else a.unfitted, proof.ends),
        candidates=ranking(a, claims),
        hidden=hidden_effects(a, claims),
        measured=list(problem.layout.outputs),
        sensor_noise=dict(zip(problem.layout.outputs, np.exp(0.5 * proof.noise.sensors).tolist(), strict=True)),
        inputs=Inputs(taken=dict(between.ways), gain_otherwise=between.gain),
        warnings=list(study.warnings),
        residual=Residual.model_validate(claims.misfit),
        replays=proof.way,
        horizon=judged if math.isfinite(judged) else "free run",
        error=errors(judged),
        horizons={name: errors(horizon) for name, horizon in OTHER_HORIZONS.items()},
        noise_floor=keep_finite(floors["validation" if "validation" in floors else "estimation"].level),
        noise_floors={part: keep_finite(floor.level) for part, floor in floors.items()},
        floor_scatters={part: keep_finite(floor.scatter) for part, floor in floors.items()},
        held_out_gain=a.total.held_out,
        seconds=proof.seconds,
    )


def _rungs(ladder: Sequence[Rung]) -> list[RungEntry]:
    """Return the entries of the ladder; a model whose predictions diverge is omitted."""
    finite = [rung for rung in ladder if np.isfinite(rung.errors).all()]
    if not finite or finite[0].hypothesis is not None:
        return []
    given, least = finite[0].errors, min(finite, key=lambda rung: float(np.mean(rung.errors))).errors
    entries = []
    for rung in finite:
        h, excess = rung.hypothesis, rung.errors - least
        model: Literal["before", "recalibrated", "candidates"] = (
            "before" if h is None else "candidates" if h.candidates else "recalibrated"
        )
        scatter = float(np.std(excess, ddof=1) / math.sqrt(excess.size)) if excess.size > 1 else None
        ratio = float(np.exp(np.mean(rung.errors - given)))
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


def effects(
    subject: Subject,
    claimed: Hypothesis,
    tried: Iterable[Hypothesis],
    candidates: Sequence[Candidate] | None = None,
) -> list[EffectEntry]:
    """Return the claimed effects, most important first.

    Args:
        candidates: Claimed candidates of the hypothesis, by default all.
    """
    declared = subject.declared
    alone = {h.names: h.score for h in tried if len(h.candidates) == 1}
    return [
        EffectEntry(
            name=c.name,
            kind=kind_within(c, subject),
            parameters={
                n.partition(".")[2] or "value": _estimate(claimed.fit, n, declared[n].unit) for n in c.parameters
            },
        )
        for c in sorted(
            claimed.candidates if candidates is None else candidates, key=lambda c: alone.get((c.name,), math.inf)
        )
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


def hidden_effects(a: Attribution, claims: Claims) -> list[str]:
    """Return effects that the logs cannot show."""
    claimed = claims.claimed.names if claims.claimed else ()
    return [name for name in a.hidden if name not in claimed]


def ranking(a: Attribution, claims: Claims) -> list[CandidateEntry]:
    """Return every hypothesis with its scores."""
    return [
        CandidateEntry(
            names=list(h.names),
            log_likelihood_gain=a.base.fit.nll - h.fit.nll,
            score_gain=a.base.score - h.score,
            fitted=h.fit.iterations > 0,
            parameters={n: float(h.fit.values[n]) for c in h.candidates for n in c.parameters},
            why=_reason(a, h, claims),
        )
        for h in a.tried
    ]


def _reason(a: Attribution, h: Hypothesis, claims: Claims) -> str:
    """Return the reason against a hypothesis, by the verdict or else by the search."""
    is_first = claims.claimed is not None and h.names == claims.claimed.names
    if TOGETHER.join(h.names) in claims.disputed:
        return f"a rival: {'fits best, by little' if is_first else 'the logs do not decide against it'}"
    if is_first:
        return "claimed"
    if h.names != a.best.names:
        return a.reasons[h.names] or _score_text(h, claims.claimed or a.best)
    if claims.name == "unexplained":
        return _unexplained_reason(h, claims)
    if claims.name == "no_effect":
        return "nothing more is missing"
    if claims.claimed is not None:
        return "only with its numbers beyond their tolerances"
    return "nothing can be said: the logs excite too little"


def _unexplained_reason(h: Hypothesis, claims: Claims) -> str:
    """Return the reason against the best supported hypothesis of an unexplained misfit."""
    why = "disputed" if h.candidates else "incomplete"
    if claims.nearest is None or claims.nearest.names == h.names:
        return f"nearest, but {why}"
    return f"{why}; held-out logs are predicted better by {join_names(claims.nearest.names) or 'the given model'}"


def _score_text(h: Hypothesis, best: Hypothesis) -> str:
    """Return the comparison of two scores in words."""
    than, behind = join_names(best.names) or "the base model", h.score - best.score
    if behind < 0.0:
        return f"gains {-behind:.1f} on {than}, but not with every part borne out"
    return f"its score is {behind:.1f} below that of {than}"
