"""`Claims`: every fact that a verdict rests on, gathered stage by stage; and the first stage, what the fits bear out.

No stage writes text: `cosim.refinement.decision.sentences.sentence` turns the facts into words when all are known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from cosim.base.text import MOST_NAMED
from cosim.refinement.decision.judgement import SIGNIFICANT, loss_without
from cosim.refinement.search.hypotheses import TOGETHER, Attribution, Hypothesis
from cosim.refinement.search.unnamed import Leftover, Unnamed
from cosim.subject.base_parameters import kind_within
from cosim.subject.candidates import Candidate
from cosim.subject.interface import Subject

Name = Literal["effect_found", "parameter_error", "sensor_error", "no_effect", "ambiguous", "unexplained"]
Grade = Literal["claimed", "part", "nearest"]
MUCH = 0.3  # of what a claim gains, from which a term without a name beside it disputes it
MOVED = 0.5  # of its size, by which a part that stands may change beside terms without a name
LARGE = 0.02  # of what moves an equation, from which an unknown input is no small disturbance
DEFAULT_EXPERIMENT = "larger and broader commands on all inputs, one at a time and together"
MORE_ROWS = "more rows, over a wider range of every input, each with each"


@dataclass(frozen=True)
class Moved:
    """A base parameter that a fit has plainly moved: its stated value, and the fitted one."""

    name: str
    stated: float
    fitted: float


@dataclass(frozen=True)
class Doubt:
    """The reason why a claim was withdrawn after replays.

    kind:    `missed`: replays with it still miss `channel` by `size` times what noise makes
             `no_nearer`: replays with it are nearer on no channel than those of the model recalibrated
             `kept`: replays with it keep a share `size` of the excess error
             `unsteady`: much is left, and predictions of held-out logs are not plainly better for `names`
    """

    kind: Literal["missed", "no_nearer", "kept", "unsteady"]
    channel: str = ""
    size: float = 0.0
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class Part:
    """The share of the excess error of a channel that replays with a claim leave."""

    channel: str
    share: float


@dataclass(frozen=True)
class Nearest:
    """The model that predicts held-out logs best, where not all is claimed; None: the model as it was given."""

    hypothesis: Hypothesis | None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its candidates."""
        return self.hypothesis.names if self.hypothesis else ()


@dataclass(frozen=True)
class Claims:
    """Facts of an answer.

    By the fits:
    name, grade, claimed: the verdict, how much of what is missing is claimed, and the hypothesis that is
    rivals:     names that the logs cannot tell apart, or that come nearest; experiment: the input that separates them
    misfit:     where something is missing and on what it depends, by the fits
    apart, certain: rivals without what they share, and candidates that they share
    unshown:    effects that these logs would not show; still: nothing moves in the logs
    moves:      forced state → size of its unknown input, as a share of what moves the state
    small:      names that gain too little to be told from chance
    beside, gained: a term without a name beside a claim, and the log-likelihood that the claim gains
    disturbed:  state whose unknown input is no small disturbance beside the claim

    By replays of the estimation logs, and of tables by what is left of their rows:
    further:    other base parameters that come out beyond their tolerances beside a claim
    missed:     channel → how many times what noise makes the unchanged model misses it; recalibrated: what was moved
    doubt:      why a claim was withdrawn
    part:       what replays with a claim leave, where it is one of a part
    left_of:    output of a table of which something is left, and the input with which it goes
    left_share: of its mean square, where that makes the claim one of a part

    By the logs left out and the sealed ones:
    nearest:    the nearest model; None where all is claimed
    restricted: only candidates that the study names were tried
    left_out:   errors on held-out rows of a table, by model and output
    risen:      channel → error before and after, where it rises on sealed logs
    written:    files are written that hold the refined and the nearest subject
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
    beside: Unnamed | None = None
    gained: float = 0.0
    disturbed: str = ""

    further: tuple[Moved, ...] = ()
    missed: tuple[str, float] | None = None
    recalibrated: tuple[Moved, ...] = ()
    doubt: Doubt | None = None
    part: Part | None = None
    left_of: tuple[str, str] | None = None
    left_share: float | None = None

    nearest: Nearest | None = None
    restricted: bool = False
    left_out: Mapping[str, Mapping[str, float]] | None = None
    risen: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    written: bool = True

    @property
    def residual(self) -> Mapping[str, Any]:
        """Where the misfit is and on what it depends, as refine.json has it."""
        if self.left_of is None:
            return self.misfit
        output, signal = self.left_of
        return {**self.misfit, "equation": output, "signals": [signal]}

    @property
    def near(self) -> Hypothesis | None:
        """What the nearest model has; the claim where all is claimed."""
        return self.claimed if self.nearest is None else self.nearest.hypothesis

    def withdrawn(self, doubt: Doubt) -> Claims:
        """Return the answer without its claim, which comes nearest, and the reason."""
        names = self.claimed.names if self.claimed else ()
        return Claims("unexplained", rivals=names, misfit=self.misfit, doubt=doubt)


def judge(
    a: Attribution, left: Leftover, subject: Subject, forced: Sequence[str], moves: Mapping[str, float], *, still: bool
) -> Claims:
    """Claim what is borne out and stands beside what has no name. Of these rules the first that applies decides.

    moves: forced state → size of its unknown input over that of its derivative on the logs
    still: nothing moves in the logs
    """
    residual, large = _misfit(a, left, forced), _large(moves)
    if not a.best.candidates:
        if still or (a.blind and not large):  # nothing is claimed of logs in which nothing would show
            rivals = a.hidden if len(a.hidden) > 1 else (*a.hidden, "no_effect")
            experiment = usual_experiment(subject)
            return Claims("ambiguous", None, rivals, experiment, residual, unshown=a.hidden, still=still)
        if left.terms:
            return Claims("unexplained", misfit=residual)
        if large:
            return Claims("unexplained", misfit={**residual, "equation": large})
        return Claims("no_effect", misfit=residual, unshown=a.hidden, moves=moves, small=a.small)
    gained = a.base.score - a.best.score
    hides = large and gained < MUCH * a.noise_gain[list(forced).index(large)]
    if hides or _disputed(a, left):
        return Claims("unexplained", rivals=a.best.names, misfit=residual)
    if a.rivals:
        return _ambiguous(a, subject, residual)
    name = name_of(a.best.candidates, subject)
    claims = Claims(name, a.best, misfit=residual, grade="claimed", small=a.small, beside=left.first, gained=gained)
    return replace(claims, grade="part", disturbed=large, moves=moves) if large else claims


def _large(moves: Mapping[str, float]) -> str:
    """Return the state with the largest unknown input that is no small disturbance; empty where none is."""
    return max((name for name in moves if moves[name] > LARGE), key=lambda name: moves[name], default="")


def _ambiguous(a: Attribution, subject: Subject, residual: Mapping[str, Any]) -> Claims:
    """Claim the best until an experiment separates it from its rivals; what they share is certain."""
    every = (a.best, *a.rivals, *([a.fuller] if a.fuller and a.fuller.score < a.best.score else []))
    common = set(a.best.names).intersection(*(h.names for h in a.rivals))
    apart = [[n for n in h.names if n not in common] for h in every]
    experiment = experiment_for(subject, [n for names in apart for n in names])
    rivals = tuple(TOGETHER.join(h.names) for h in every)
    short = tuple(TOGETHER.join(names) if len(names) <= MOST_NAMED else f"{len(names)} candidates" for names in apart)
    claims = Claims("ambiguous", a.best, rivals, experiment, residual, apart=short)
    return replace(claims, certain=tuple(c for c in a.best.candidates if c.name in common))


def usual_experiment(subject: Subject) -> str:
    """Return what tells more of any subject of this kind."""
    return MORE_ROWS if subject.static else DEFAULT_EXPERIMENT


def experiment_for(subject: Subject, names: Sequence[str]) -> str:
    """Return the input that would separate these rivals, as the subject says."""
    known = [(len(row & set(names)), text) for row, text in subject.told_apart_by.items()]
    shared, text = max(known, default=(0, ""))
    return text if shared > 1 else usual_experiment(subject)


def name_of(candidates: Sequence[Candidate], subject: Subject) -> Name:
    """Return the verdict that claims these candidates, by their kind."""
    kinds = {kind_within(c, subject) for c in candidates}
    return "parameter_error" if kinds == {"parameter"} else "sensor_error" if kinds == {"sensor"} else "effect_found"


def _disputed(a: Attribution, left: Leftover) -> bool:
    """Whether terms without a name gain much beside the claim, or take the place of a part that only stood for them."""
    if left.fit is None:
        return False
    if left.gain > MUCH * (a.base.score - a.best.score):
        return True
    beside = Hypothesis(a.best.candidates, left.fit, 0.0)
    neutral = {
        f.name: f.neutral if f.neutral is not None else a.base.fit.values.get(f.name, 0.0) for f in left.fit.free
    }
    for c in a.best.candidates:
        if loss_without(beside, c, neutral) < left.cost:
            return True
        for f in c.free:
            if f.neutral is not None:
                was, now = a.best.fit.values[f.name] - f.neutral, left.fit.values[f.name] - f.neutral
                if abs(now - was) > MOVED * abs(was) and abs(now - was) > SIGNIFICANT * a.best.fit.sigma(f.name):
                    return True
    return False


def _misfit(a: Attribution, left: Leftover, forced: Sequence[str]) -> dict[str, Any]:
    """Return where the misfit is and on what it depends."""
    q0, q1 = a.base.fit.noise.density, a.best.fit.noise.density
    noise = {
        equation: {"before": float(q0[k]), "after": float(q1[k]), "inflated": a.noisy[k], "gain": a.noise_gain[k]}
        for k, equation in enumerate(forced)
    }
    # densities of states in different units do not compare; what they are worth does
    inflated = {name: entry["gain"] for name, entry in noise.items() if entry["inflated"]}
    where = left.first.equation if left.first else max(inflated, key=lambda k: inflated[k], default=None)
    return {
        "equation": where,
        "signals": list(dict.fromkeys(u.signal for u in left.terms if u.equation == where)),
        "share": left.first.share if left.first else None,
        "process_noise": noise,
        "terms": [u.entry for u in left.terms],
    }
