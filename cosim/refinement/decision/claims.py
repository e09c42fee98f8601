"""`Claims`, the facts behind a verdict, and their first stage: the judgement of the fits.

No stage writes text: `cosim.refinement.decision.sentences.sentence` turns the complete facts into words.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any, Literal

import numpy as np

from cosim.core.arrays import Array
from cosim.core.text import MOST_NAMED
from cosim.estimation.fit import Fit
from cosim.estimation.subject.candidates import Candidate, Free, kind_within
from cosim.estimation.subject.interface import Subject
from cosim.logs.channel_noise import NORMAL_95
from cosim.refinement.decision.judgement import SIGNIFICANT, loss_without
from cosim.refinement.search.hypotheses import TOGETHER, Attribution, Hypothesis
from cosim.refinement.search.unnamed import Leftover, UnnamedTerm

Name = Literal["effect_found", "parameter_error", "sensor_error", "no_effect", "ambiguous", "unexplained"]
Grade = Literal["claimed", "part", "nearest"]
MUCH = 0.3  # share of a claim's gain from which an unnamed term beside the claim disputes it
MOVED = 0.5  # relative change of a claimed part in another fit from which the part is disputed
LARGE = 0.02  # share of the derivative from which an unknown input is no longer a small disturbance
DEFAULT_EXPERIMENT = "larger and broader commands on all inputs, one at a time and together"


@dataclass(frozen=True)
class MovedParameter:
    """A base parameter that a fit moved clearly: stated and fitted value."""

    name: str
    stated: float
    fitted: float


@dataclass(frozen=True)
class Doubt:
    """The reason for which replays, predictions, unknown inputs or unnamed terms withdraw a claim.

    Attributes:
        kind: `missed`: the error of `channel` in replays with the claim is still `size` times the noise floor;
            `no_nearer`: the model without it, recalibrated, is as good or better on every channel;
            `kept`: a share `size` of the excess error remains;
            `unsteady`: much error remains, and `names` do not clearly improve predictions of held-out logs;
            `disagreeing`: a fit to predictions gives other values of `names` and predicts held-out logs better;
            `disturbed`: an unknown input of a share `size` of the derivative of the state `channel` remains beside it;
            `replaced`: terms without a name replace all its parts;
            `varying`: the parameter `names` has other `estimates` from rows in which it acts weakly, and strongly;
            `refused`: `names` gains far more than chance, but for a `reason` cannot be claimed.
    """

    kind: Literal[
        "missed", "no_nearer", "kept", "unsteady", "disagreeing", "disturbed", "replaced", "varying", "refused"
    ]
    channel: str = ""
    size: float = 0.0
    names: tuple[str, ...] = ()
    estimates: tuple[float, float] = (0.0, 0.0)
    reason: str = ""


@dataclass(frozen=True)
class Part:
    """The share of a channel's excess error that remains in replays with a claim.

    Excess is the mean square error above the noise floor.

    Attributes:
        sealed: True if the replays are those of sealed logs.
    """

    channel: str
    share: float
    sealed: bool = False


@dataclass(frozen=True)
class NotExcluded:
    """An effect possible in place of a claimed special case.

    Attributes:
        parameter: Name of the parameter in which both differ, without that of the effect.
        up_to: Largest value in its 95 % interval.
    """

    name: str
    in_place_of: str
    parameter: str
    up_to: float
    unit: str


@dataclass(frozen=True)
class Nearest:
    """The best predictor of held-out logs beside an incomplete claim; None stands for the given model.

    Attributes:
        moved: Its base parameters that were recalibrated beyond their tolerances.
        why: Reason for which the search refused it, in words; "" for none.
    """

    hypothesis: Hypothesis | None
    moved: tuple[MovedParameter, ...] = ()
    why: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Return the candidates' names in the nearest model."""
        return self.hypothesis.names if self.hypothesis else ()


@dataclass(frozen=True)
class Improvement:
    """The share of a reference model's squared error that remains with a claim, or with the nearest model.

    Attributes:
        remaining: Channel → remaining share; a single entry without name for the mean over the channels.
        baseline: Reference model.
        logs: Logs of the errors; those of held-out logs are errors of predictions by fits to the other logs.
        is_excess: True if only the error above the noise floor counts.
        is_clear: True if the error decreases by more than its scatter.
    """

    remaining: Mapping[str, float]
    baseline: Literal["before", "recalibrated"]
    logs: Literal["sealed", "held-out"] = "sealed"
    is_excess: bool = True
    is_clear: bool = True

    @property
    def share(self) -> float:
        """Return the mean remaining share."""
        return sum(self.remaining.values()) / len(self.remaining)

    @property
    def worst(self) -> str:
        """Return the channel with the largest remaining share; "" for a single one."""
        return max(self.remaining, key=lambda name: self.remaining[name]) if len(self.remaining) > 1 else ""


@dataclass(frozen=True, eq=False)
class Rung:
    """A model on the ladder from the given model (None) to the hypotheses, simplest first.

    Attributes:
        errors: Mean log RMSE of the outputs in predictions of each held-out log.
    """

    hypothesis: Hypothesis | None
    errors: Array


@dataclass(frozen=True)
class Claims:
    """Facts of a verdict, filled stage by stage.

    Attributes:
        name, grade, claimed: Verdict, completeness of the claim, and the claimed hypothesis (from the fits, as up to
            `disturbed`).
        rivals: Names that the logs cannot distinguish, or the closest names.
        experiment: Input that separates the rivals.
        misfit: Deficient equation and the signals on which the misfit depends, from the fits.
        apart, certain: Rivals without their common candidates, and the common candidates.
        unshown: Effects that these logs cannot show.
        still: True if nothing moves in the logs.
        moves: Forced state → size of its unknown input relative to the state's derivative.
        small: Names with a gain too small to distinguish from chance.
        term, gained: Unnamed term beside a claim, and the log-likelihood gain of the claim.
        disturbed: State whose unknown input is no small disturbance beside the claim.
        replaced: Parts of the best hypothesis that an unnamed term replaces.
        disagreeing: Parts of the best hypothesis for which a fit to predictions gives other values.
        beside: Parts of the best hypothesis that do not halve the held-out error, as those of the claim do.
        alike: Groups of names that act alike for every input, the first of them from the best hypothesis or a rival.
        not_excluded: Effects of which claimed ones are special cases, as far as the logs leave a difference open.
        others: Rivals of an ambiguous verdict besides the claimed hypothesis.
        varying: Parameter of the best hypothesis that varies with its own effect.
        inputs: Line of a study that takes inputs between rows the other way, if that is clearly likelier.
        further: Other base parameters outside their tolerances beside a claim (from replays, as up to `unjudged`).
        missed_channel: Channel and its error with the unchanged model, as a multiple of the noise floor.
        recalibrated: Base parameters moved beyond their tolerances.
        doubt: Reason for a withdrawn claim.
        part: Remaining error if the claim explains only a part.
        divided: Channel that sealed logs do not judge: there, estimates within their intervals differ as much as the
            claim misses it.
        unjudged: Channel that replays do not judge: there, two runs of the model with noise differ as much.
        nearest: Nearest model; None if the claim is complete (from held-out and sealed logs, as the rest).
        ladder: Errors of predictions of held-out logs by number of candidates.
        restricted: True if the study limits the candidates.
        missed: Channel that the best rival misses most on sealed logs → its error as a multiple of the noise floor,
            if every rival misses a channel by more than twice the floor.
        risen: Channel → error before and after, if the error rises on sealed logs.
        improvement: Error that remains with the claim on sealed logs; without a claim, with the nearest model on sealed
            or held-out logs.
        written: True if files of the refined and the nearest subject are written.
    """

    name: Name
    claimed: Hypothesis | None = None
    rivals: tuple[str, ...] = ()
    experiment: str = ""
    misfit: Mapping[str, Any] = field(default_factory=dict)
    grade: Grade = "nearest"
    apart: tuple[str, ...] = ()
    certain: tuple[Candidate, ...] = ()
    unshown: tuple[str, ...] = ()
    still: bool = False
    moves: Mapping[str, float] = field(default_factory=dict)
    small: tuple[str, ...] = ()
    term: UnnamedTerm | None = None
    gained: float = 0.0
    disturbed: str = ""
    replaced: tuple[str, ...] = ()
    disagreeing: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()
    alike: tuple[tuple[str, ...], ...] = ()
    not_excluded: tuple[NotExcluded, ...] = ()
    others: tuple[Hypothesis, ...] = ()
    varying: Doubt | None = None
    inputs: str = ""

    further: tuple[MovedParameter, ...] = ()
    missed_channel: tuple[str, float] | None = None
    recalibrated: tuple[MovedParameter, ...] = ()
    doubt: Doubt | None = None
    part: Part | None = None
    divided: str = ""
    unjudged: str = ""

    nearest: Nearest | None = None
    ladder: tuple[Rung, ...] = ()
    restricted: bool = False
    missed: Mapping[str, float] = field(default_factory=dict)
    risen: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    improvement: Improvement | None = None
    written: bool = True

    @property
    def is_doubtful(self) -> bool:
        """Return whether the claim may only imitate what is missing: it, or a base parameter beside it, says so."""
        return self.grade == "part" and (self.varying is not None or bool(self.further))

    @property
    def nearest_hypothesis(self) -> Hypothesis | None:
        """Return the nearest model's hypothesis, by default the claim."""
        return self.claimed if self.nearest is None else self.nearest.hypothesis

    def floor_hypothesis(self, a: Attribution) -> Hypothesis:
        """Return the hypothesis of the noise floor: the nearest model's, by default the base parameters alone."""
        return self.nearest_hypothesis or a.base

    @property
    def claimed_candidates(self) -> tuple[Candidate, ...]:
        """Return the claimed candidates; for an ambiguous verdict, the candidates common to all rivals."""
        if self.claimed is None:
            return ()
        return self.certain if self.name == "ambiguous" else self.claimed.candidates

    @property
    def disputed(self) -> frozenset[str]:
        """Return the rivals of an ambiguous verdict on fits, `a + b` for two candidates together."""
        return frozenset(self.rivals if self.name == "ambiguous" and self.claimed is not None else ())

    @property
    def namesakes(self) -> tuple[tuple[str, ...], ...]:
        """Return the groups of names that act alike, of which the first is claimed, or part of a rival."""
        hypotheses = self.rivals if self.name == "ambiguous" else self.claimed.names if self.claimed else ()
        named = {name for text in hypotheses for name in text.split(TOGETHER)}
        return tuple(group for group in self.alike if named.issuperset(group[0].split(TOGETHER)))

    def withdraw(self, doubt: Doubt) -> Claims:
        """Return the verdict `unexplained` with its reason."""
        names = self.claimed.names if self.claimed else ()
        return Claims("unexplained", rivals=names, misfit=self.misfit, doubt=doubt)


def baseline_of(candidates: Sequence[Candidate]) -> Literal["before", "recalibrated"]:
    """Return the model for comparison with candidates: `before` for wrong parameters alone, else `recalibrated`."""
    return "recalibrated" if any(c.kind != "parameter" for c in candidates) else "before"


def judge(
    a: Attribution,
    leftover: Leftover,
    subject: Subject,
    forced: Sequence[str],
    moves: Mapping[str, float],
    *,
    still: bool,
) -> Claims:
    """Return the claim of the first matching rule.

    Args:
        moves: Forced state → size of its unknown input relative to the state's derivative on the logs.
        still: True if nothing moves in the logs.
    """
    residual, large = _misfit(a, leftover, forced), _largest_disturbance(moves)
    if a.best.candidates:
        return _judge_claim(a, leftover, subject, residual, large, moves)
    if still or (a.is_blind and not large):  # Logs in which no effect would show support no claim.
        rivals = a.hidden if len(a.hidden) > 1 else (*a.hidden, "no_effect")
        experiment = DEFAULT_EXPERIMENT
        return Claims("ambiguous", None, rivals, experiment, residual, unshown=a.hidden, still=still)
    if leftover.terms:
        return Claims("unexplained", misfit=residual)
    if large:
        return Claims("unexplained", misfit={**residual, "equation": large})
    if a.refused:
        name, reason = next(iter(a.refused.items()))
        doubt = Doubt("refused", names=(name,), reason=reason)
        return Claims("unexplained", rivals=(name,), misfit=residual, doubt=doubt)
    return Claims("no_effect", misfit=residual, unshown=a.hidden, moves=moves, small=a.small_parts)


def _judge_claim(
    a: Attribution,
    leftover: Leftover,
    subject: Subject,
    residual: Mapping[str, Any],
    large: str,
    moves: Mapping[str, float],
) -> Claims:
    """Return the claim of the best hypothesis, as far as neither unknown inputs nor unnamed terms speak against it.

    A hypothesis with an effect or a sensor error that halves the held-out error stays at least a part of the answer. A
    wrong parameter alone does not: beside a missing term, a parameter of its equation often takes a part of its place.

    Args:
        large: State with an unknown input that is no small disturbance, or "".
    """
    gained = a.base.score - a.best.score
    disputed = _disputed_parts(a, leftover)
    certain = fit_of_rest(a, disputed) if disputed else a.best
    halves = a.halves_error and not a.best.is_of_parameters
    if certain is None and halves:
        certain = a.best
    if (large and not halves) or certain is None:
        doubt = Doubt("disturbed", large, moves[large]) if large and not halves else Doubt("replaced")
        return Claims("unexplained", rivals=a.best.names, misfit=residual, doubt=doubt)
    if a.rivals:
        return _ambiguous_claims(a, subject, residual)
    name = name_of(certain.candidates, subject)
    claims = Claims(name, certain, misfit=residual, grade="claimed", small=a.small_parts, term=leftover.stable_first)
    claims = replace(claims, gained=gained, alike=alike_groups(a.alike))
    if not (large or disputed):
        return claims
    return replace(claims, grade="part", disturbed=large, moves=moves, replaced=tuple(sorted(disputed)))


def fit_of_rest(a: Attribution, disputed: Collection[str]) -> Hypothesis | None:
    """Return the earlier fit without disputed parts, if any."""
    names = tuple(n for n in a.best.names if n not in disputed)
    return next((h for h in a.tried if names and h.names == names), None)


def _largest_disturbance(moves: Mapping[str, float]) -> str:
    """Return the state with the largest unknown input, or "" if all are small disturbances."""
    return max((name for name in moves if moves[name] > LARGE), key=lambda name: moves[name], default="")


def _ambiguous_claims(a: Attribution, subject: Subject, residual: Mapping[str, Any]) -> Claims:
    """Return ambiguous claims: rivals, and their common candidates."""
    hypotheses = (a.best, *a.rivals, *([a.fuller] if a.fuller and a.fuller.score < a.best.score else []))
    common = set(a.best.names).intersection(*(h.names for h in a.rivals))
    apart = [sorted(set(h.names) - common) for h in hypotheses]
    experiment = experiment_for(subject, list(chain(*apart)))
    rivals = tuple(TOGETHER.join(h.names) for h in hypotheses)
    short = tuple(TOGETHER.join(names) if len(names) <= MOST_NAMED else f"{len(names)} candidates" for names in apart)
    best = _with_intervals_of(a.best, a.rivals, common)
    claims = Claims("ambiguous", best, rivals, experiment, residual, apart=short, alike=alike_groups(a.alike))
    certain = tuple(c for c in a.best.candidates if c.name in common)
    return replace(claims, certain=certain, others=hypotheses[1:], grade="part" if certain else "nearest")


def alike_groups(alike: Mapping[tuple[str, ...], Hypothesis]) -> tuple[tuple[str, ...], ...]:
    """Return groups of names that act alike, without what both hypotheses contain.

    Args:
        alike: Names of a hypothesis → hypothesis that it acts like.
    """
    groups: dict[str, list[str]] = {}
    for names, h in alike.items():
        one, other = (TOGETHER.join(sorted(set(x) - set(y))) for x, y in ((h.names, names), (names, h.names)))
        groups.setdefault(one, [one]).append(other)
    return tuple(map(tuple, groups.values()))


def _with_intervals_of(best: Hypothesis, rivals: Sequence[Hypothesis], common: Collection[str]) -> Hypothesis:
    """Return the best hypothesis with intervals of common candidates widened to include those of all rivals."""
    fit, wider = best.fit, np.ones(len(best.fit.free))
    shared = {f.name for c in best.candidates if c.name in common for f in c.free}
    for k, f in enumerate(fit.free):
        if f.name in shared and (sigma := fit.sigma(f.name)) > 0.0:
            reach = [abs(h.fit.values[f.name] - fit.values[f.name]) / NORMAL_95 + h.fit.sigma(f.name) for h in rivals]
            wider[k] = max(1.0, *(r / sigma for r in reach))
    sigmas = np.array([fit.sigma(f.name) for f in fit.free])
    covariance = np.diag(sigmas**2) if fit.scattered is None else fit.scattered
    regions = {n: _span([fit.interval(n), *(h.fit.interval(n) for h in rivals if n in shared)]) for n in fit.regions}
    return replace(best, fit=replace(fit, scattered=covariance * np.outer(wider, wider), regions=regions))


def _span(intervals: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the interval that contains all intervals."""
    lows, highs = zip(*intervals, strict=True)
    return min(lows), max(highs)


def experiment_for(subject: Subject, names: Sequence[str]) -> str:
    """Return the experiment to separate these rivals."""
    experiments = [(len(row & set(names)), text) for row, text in subject.told_apart_by.items()]
    shared, text = max(experiments, default=(0, ""))
    return text if shared > 1 else DEFAULT_EXPERIMENT


def name_of(candidates: Sequence[Candidate], subject: Subject) -> Name:
    """Return the verdict for the kinds of claimed candidates."""
    kinds = {kind_within(c, subject) for c in candidates}
    names: dict[str, Name] = {"effect": "effect_found", "sensor": "sensor_error", "parameter": "parameter_error"}
    return next(name for kind, name in names.items() if kind in kinds)


def _disputed_parts(a: Attribution, leftover: Leftover) -> set[str]:
    """Return a claim's parts superfluous beside unnamed terms.

    These are all parts if the unnamed terms gain much beside the claim.
    """
    if leftover.fit is None:
        return set()
    if leftover.gain > MUCH * (a.base.score - a.best.score) and not a.halves_error:
        return set(a.best.names)
    refitted, other = Hypothesis(a.best.candidates, leftover.fit, 0.0), leftover.fit
    neutral = {f.name: f.neutral if f.neutral is not None else a.base.fit.values.get(f.name, 0.0) for f in other.free}
    return {
        c.name
        for c in a.best.candidates
        if loss_without(refitted, c, neutral) < leftover.cost or any(is_moved(f, a.best.fit, other) for f in c.free)
    }


def is_moved(f: Free, alone: Fit, other: Fit) -> bool:
    """Return True if another fit moves a parameter of a claim clearly and by a large share."""
    if f.neutral is None:
        return False
    change = abs(other.values[f.name] - alone.values[f.name])
    return change > MOVED * abs(alone.values[f.name] - f.neutral) and change > SIGNIFICANT * alone.sigma(f.name)


def _misfit(a: Attribution, leftover: Leftover, forced: Sequence[str]) -> dict[str, Any]:
    """Return the deficient equation, the signals of the misfit and the process noise, from the fits."""
    q0, q1 = a.base.fit.noise.density, a.best.fit.noise.density
    noise = {
        equation: {
            "before": float(q0[k]),
            "after": float(q1[k]),
            "inflated": a.has_unknown_input[k],
            "gain": a.noise_gain[k],
        }
        for k, equation in enumerate(forced)
    }
    # Noise densities of states with different units are not comparable; likelihood gains are.
    inflated = {name: entry["gain"] for name, entry in noise.items() if entry["inflated"]}
    terms = leftover.terms if leftover.is_stable else ()
    where = terms[0].equation if terms else max(inflated, key=lambda k: inflated[k], default=None)
    signals = list(dict.fromkeys(u.signal for u in terms if u.equation == where))
    if not leftover.is_placed:
        where, signals = None if terms else where, signals[:1]
    return {
        "equation": where,
        "signals": signals,
        "share": terms[0].share if terms else None,
        "process_noise": noise,
        "terms": [u.entry for u in leftover.terms],
    }
