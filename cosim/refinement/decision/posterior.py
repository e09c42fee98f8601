"""The verdict of a refinement, from the posterior over sets of parts: a pure function of a bundle of fits.

The evidence of a hypothesis is a Gaussian integral about its estimate θ̂, which need be no optimum,

    ln E = ℓ/κ − ½ m'S⁻¹m + ½ b'H⁻¹b − ½ ln|S·H|      H = F/κ + S⁻¹,  b = −g/κ + S⁻¹m,  m = prior mean − θ̂

with the log-likelihood ℓ, the gradient g of −ℓ, the information F, from which the noise levels are integrated out,
and the covariance S of the prior. Limits cut the priors off. κ is the dispersion of a composite likelihood (Varin, Reid
and Firth 2011, Statistica Sinica 21:5), the same for all hypotheses of a study. Sizes have a scale mixture of normal
priors, so that no verdict hangs on one width.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Literal

import numpy as np
from scipy.special import chdtrc, log_ndtr, logsumexp

from cosim.core.arrays import Array, Rows
from cosim.residuals.residual_statistics import COUNTS_FROM

# The numbers that decide, with `COUNTS_FROM` of replays.
CERTAIN = 0.95  # inclusion probability from which a part is claimed; mass of the classes of an ambiguous verdict
POSSIBLE = 1.0 - CERTAIN  # probability of a class from which it counts beside others
PART = 0.5  # prior factor of each further part
MIXTURE = (1 / 3, 1.0, 3.0)  # widths of the prior of a size, in usual sizes
TRIAL_TOLERANCE = 0.05  # of a base number on trial without a stated one; it is the least width of the prior
MISFIT = 1e-3  # probability below which a lack of fit is no chance
UNKNOWN_INPUT = 0.02  # share of a derivative that unknown inputs may carry, unless replays show what a claim removes
LITTLE = 0.1  # share of the excess error that may remain beside a complete claim
UNEXPLAINED = 0.5  # share of the excess error that may remain beside any claim
CLEARLY = 0.05  # difference of the log errors of predictions from which exact equations are better
EQUIVALENT = 1e-3  # share of an effect's response below which a difference is that of rounding and integration

Kind = Literal["effect", "sensor", "parameter"]
Verdict = Literal["effect_found", "parameter_error", "sensor_error", "no_effect", "ambiguous", "unexplained"]
Grade = Literal["claimed", "part", "nearest"]
Names = frozenset[str]


def chance_of_gain(gain: float, count: int) -> float:
    """Return the probability by chance of a log-likelihood gain from as many parameters, by the χ² test."""
    return float(chdtrc(count, 2.0 * np.maximum(gain, 0.0)))


@dataclass(frozen=True)
class Parameter:
    """A free parameter of a hypothesis with its prior.

    Attributes:
        part: Candidate that it belongs to; "" for a base number that is not on trial.
        centre, width: Mean and standard deviation of the prior; an infinite width for none.
        is_size: Whether the width of the prior is a mixture.
        low, high: Limits, at which the prior is cut off: a size that cannot be negative has half of a normal prior.
    """

    name: str
    part: str
    value: float
    centre: float
    width: float
    is_size: bool = False
    low: float = -math.inf
    high: float = math.inf


@dataclass(frozen=True, eq=False)
class Evidence:
    """A fit of some parts, by blocks of time, with the noise levels integrated out.

    Attributes:
        log_likelihoods, logs: Log-likelihood of each block, and the log to which it belongs.
        gradients: Of −ℓ by the parameters, shape (blocks, parameters).
        informations: Of each log, shape (logs, parameters, parameters).
    """

    parts: Names
    parameters: tuple[Parameter, ...]
    log_likelihoods: Array
    gradients: Array
    informations: Array
    logs: Rows


@dataclass(frozen=True)
class Misfit:
    """Lack of fit of the most probable class.

    Attributes:
        probability: Of unnamed terms that improve the fit as much by chance.
        beside: Part → its probability beside these terms.
        unknown_share: Largest share of a derivative that unknown inputs carry.
        remaining: Channel with excess error of the given model → share of it that remains.
        over_floor: Channel → error over the horizon, in noise floors.
    """

    probability: float = 1.0
    beside: Mapping[str, float] = field(default_factory=dict)
    unknown_share: float = 0.0
    remaining: Mapping[str, float] = field(default_factory=dict)
    over_floor: Mapping[str, float] = field(default_factory=dict)

    @property
    def remains(self) -> float:
        """Return the mean share of excess error that remains; 0 without excess error."""
        return float(np.mean([*self.remaining.values()])) if self.remaining else 0.0


@dataclass(frozen=True)
class Bundle:
    """What a study's verdict depends on.

    Attributes:
        kinds: Kind of every part on trial.
        equivalent: Pairs of hypotheses that no input tells apart.
        families: Rich part → the simple part that it contains.
        hidden: Effects that the logs would not show at their usual size.
        unsure: Parts with intervals that hold the values without them, or those of their special cases.
    """

    hypotheses: Sequence[Evidence]
    kinds: Mapping[str, Kind]
    equivalent: Sequence[tuple[Names, Names]] = ()
    families: Mapping[str, str] = field(default_factory=dict)
    hidden: Names = frozenset()
    unsure: Names = frozenset()
    misfit: Misfit = Misfit()


@dataclass(frozen=True)
class Decision:
    """The verdict, with what it follows from.

    Attributes:
        claimed: Part → its posterior probability.
        rivals: Folded classes of an ambiguous verdict → probability, most probable first.
        uncertain: Base numbers and parts that are neither claimed nor excluded → probability.
        not_excluded: Rich part, and the claimed simple part in whose place it is possible → probability.
        classes: All folded classes → probability, most probable first.
        inclusion: Part → sum over the classes that contain it.
        disputed: Parts that are not claimed beside unnamed terms.
        aside: Parts that rivals leave out: those disputed, and uncertain base numbers beside certain parts.
        nearest, misfit: The most probable class, and its lack of fit.
        reasons: What stood against a claim.
    """

    verdict: Verdict
    grade: Grade
    claimed: Mapping[str, float]
    rivals: Mapping[Names, float]
    uncertain: Mapping[str, float]
    not_excluded: Mapping[tuple[str, str], float]
    classes: Mapping[Names, float]
    inclusion: Mapping[str, float]
    disputed: Names
    aside: Names
    nearest: Names
    dispersion: float
    misfit: Misfit
    reasons: tuple[str, ...] = ()

    def is_rival(self, parts: Names) -> bool:
        """Return whether a set of parts is one of the rivals."""
        return parts - self.aside in self.rivals


def dispersion(h: Evidence) -> float:
    """Return κ ≥ 1: the variance of the score over its information, the mean over the parameters."""
    if not h.parameters:
        return 1.0
    centred = h.gradients - h.gradients.mean(axis=0)
    variance = centred.T @ centred * len(centred) / max(1, len(centred) - 1)
    return max(1.0, float(np.trace(_solve(h.informations.sum(axis=0), variance))) / len(h.parameters))


def log_evidence(h: Evidence, kappa: float) -> float:
    """Return ln E: the mean over the widths of the mixture, those of one part together."""
    parts = sorted({p.part for p in h.parameters if p.is_size})
    of_widths = []
    for widths in product(MIXTURE, repeat=len(parts)):
        scale = dict(zip(parts, widths, strict=True))
        of_widths.append(_log_evidence(h, kappa, [scale.get(p.part, 1.0) if p.is_size else 1.0 for p in h.parameters]))
    evidence = float(logsumexp(of_widths)) - math.log(len(of_widths))
    return evidence if math.isfinite(evidence) else -math.inf  # of a filter that diverges beside the estimate


def _log_evidence(h: Evidence, kappa: float, scales: Sequence[float]) -> float:
    """Return ln E for given widths of the priors."""
    likelihood = float(h.log_likelihoods.sum()) / kappa
    if not h.parameters:
        return likelihood
    width = np.array([p.width for p in h.parameters]) * scales
    away = np.array([p.centre - p.value for p in h.parameters])
    precision = width**-2.0
    H = h.informations.sum(axis=0) / kappa + np.diag(precision)
    b = -h.gradients.sum(axis=0) / kappa + precision * away
    step = _solve(H, b)
    proper = np.isfinite(width)
    log_volume = float(np.linalg.slogdet(H)[1]) + 2.0 * float(np.sum(np.log(width[proper])))
    result = likelihood - 0.5 * float(precision @ away**2) + 0.5 * float(b @ step) - 0.5 * log_volume
    deviations = np.sqrt(np.clip(np.diag(_solve(H, np.eye(len(H)))), 1e-300, None))
    for p, moved, deviation, scale in zip(h.parameters, step, deviations, width, strict=True):  # cut off at limits
        result += _log_inside(p, p.value + moved, float(deviation))
        if math.isfinite(scale):
            result -= _log_inside(p, p.centre, float(scale))
    return result


def _log_inside(p: Parameter, mean: float, deviation: float) -> float:
    """Return ln of the probability that a normal variable is within the limits of a parameter."""
    low, high = (p.low - mean) / deviation, (p.high - mean) / deviation
    if low > -high:  # both ends in the tail that is computed without cancellation
        low, high = -high, -low
    upper, lower = float(log_ndtr(high)), float(log_ndtr(low))
    return upper + math.log1p(-math.exp(min(0.0, lower - upper))) if lower < upper else -math.inf


def _solve(matrix: Array, right: Array) -> Array:
    """Return the solution of linear equations, scaled by the diagonal; least squares where it is singular."""
    scale = np.sqrt(np.clip(np.diag(matrix), 0.0, None))
    scale[scale == 0.0] = 1.0
    solution = np.linalg.lstsq(matrix / np.outer(scale, scale), (right.T / scale).T, rcond=1e-12)[0]
    return np.asarray((solution.T / scale).T)


def log_prior(size: int, count: int) -> float:
    """Return ln ½ᵏ/C(N, k), the prior of k = `size` of N = `count` parts (Scott, Berger 2010, Ann. Stat. 38:2587)."""
    return size * math.log(PART) - math.log(math.comb(count, size))


def posterior(hypotheses: Sequence[Evidence], count: int) -> tuple[dict[Names, float], float]:
    """Return set of parts → probability, and the dispersion, which is that of the likeliest hypothesis.

    The dispersion of a poor hypothesis holds its lack of fit (Burnham and Anderson 2002, Model Selection, 2.5).

    Args:
        count: Number of parts on trial.
    """
    kappa = dispersion(max(hypotheses, key=lambda h: float(h.log_likelihoods.sum())))
    log_weights = {h.parts: log_evidence(h, kappa) + log_prior(len(h.parts), count) for h in hypotheses}
    total = logsumexp([*log_weights.values()])
    return {parts: math.exp(weight - total) for parts, weight in log_weights.items()}, kappa


def folded(sets: Mapping[Names, float], equivalent: Iterable[tuple[Names, Names]]) -> dict[Names, float]:
    """Return classes with their probabilities, most probable first, named by their most probable sets.

    Equivalent sets are one class. A class joins its most probable subset that is more probable than itself, both before
    folding: a part that explains nothing would otherwise keep the few per cent of its prior, and make every true claim
    uncertain.
    """
    weight = dict(sets)
    for one, other in equivalent:
        if one in weight and other in weight:
            more, less = sorted((one, other), key=lambda parts: -weight[parts])
            weight[more] += weight.pop(less)
    alone = dict(weight)
    for parts in sorted(alone, key=lambda parts: -len(parts)):
        hosts = [other for other in alone if other < parts and alone[other] > alone[parts]]
        if hosts:
            weight[max(hosts, key=lambda other: alone[other])] += weight.pop(parts)
    return dict(sorted(weight.items(), key=lambda item: -item[1]))


def by_family(
    sets: Mapping[Names, float], families: Mapping[str, str], unsure: Names = frozenset()
) -> dict[Names, float]:
    """Return sets with rich parts under the names of their special cases, unless these are certain by themselves.

    A set of which the special case was not fitted joins a more probable part of that, as in `folded`.

    Args:
        unsure: Rich parts that intervals do not tell from their special cases.
    """
    named = dict(sets)
    for rich, simple in families.items():
        if rich in unsure or inclusion(named).get(rich, 0.0) < CERTAIN:
            special = {parts: parts - {rich} | {simple} for parts in named if rich in parts}
            merged = defaultdict[Names, float](float)
            for parts, p in named.items():
                merged[special[parts] if special.get(parts) in named else parts] += p
            for parts in [parts for parts in special if parts in merged]:
                hosts = [o for o in merged if simple in o and o < special[parts] and merged[o] > merged[parts]]
                if hosts:
                    merged[max(hosts, key=lambda other: merged[other])] += merged.pop(parts)
            named = dict(merged)
    return named


def inclusion(classes: Mapping[Names, float]) -> dict[str, float]:
    """Return part → inclusion probability: the sum over all classes with this part."""
    return {n: sum(p for parts, p in classes.items() if n in parts) for n in sorted(frozenset[str]().union(*classes))}


def decide(bundle: Bundle) -> Decision:
    """Return the verdict of a study."""
    sets, kappa = posterior(bundle.hypotheses, len(bundle.kinds))
    classes = folded(by_family(sets, bundle.families, bundle.unsure), bundle.equivalent)
    numbers, nearest, misfit = inclusion(classes), next(iter(classes)), bundle.misfit
    certain = {name: p for name, p in numbers.items() if p >= CERTAIN}
    withdrawn = {name for name in certain if name in bundle.unsure}
    certain = {name: p for name, p in certain.items() if name not in withdrawn}
    # a posterior means nothing where every hypothesis is wrong: what remains is then compared with what has no name
    is_misfit = misfit.probability < MISFIT
    # a base number absorbs what the model lacks, also beside terms that have no name
    disputed = {n for n in certain if bundle.kinds[n] == "parameter" or misfit.beside.get(n, 1.0) < CERTAIN}
    disputed = disputed if is_misfit else set()
    certain = {n: p for n, p in certain.items() if n not in disputed}
    reasons = ["misfit"] if is_misfit and not certain else []
    # unknown inputs may hold what a claim imitates, unless replays without them show it
    is_seen = bool(certain and misfit.remaining) and misfit.remains <= UNEXPLAINED
    if misfit.unknown_share > UNKNOWN_INPUT and not is_seen:
        reasons.append("unknown inputs")
    over = max(misfit.over_floor.values(), default=0.0) > COUNTS_FROM
    if (is_misfit and misfit.remains > UNEXPLAINED) if certain else over:
        reasons.append("excess error")
    # an uncertain base number beside certain parts is said, and leaves the verdict
    aside = disputed | {n for n in numbers if certain and bundle.kinds[n] == "parameter" and n not in certain}
    merged = defaultdict[Names, float](float)
    for parts, probability in classes.items():
        merged[parts - aside] += probability
    rivals: dict[Names, float] = {}
    for parts, probability in sorted(merged.items(), key=lambda item: -item[1]):
        rivals[parts] = probability
        if sum(rivals.values()) >= CERTAIN:
            break
    effects = {n for n, kind in bundle.kinds.items() if kind == "effect"}
    if not reasons and rivals.keys() == {frozenset()} and bundle.hidden >= effects > set():
        reasons.append("nothing would show")
        rivals |= {frozenset({name}): 0.0 for name in sorted(bundle.hidden)}
    if len(rivals) == 1:  # what was withdrawn may be missing in it
        (only,) = rivals
        rivals.setdefault(only.difference(withdrawn), 0.0)
    kinds = {bundle.kinds[name] for name in certain}
    verdict: Verdict = "no_effect"
    if {"misfit", "excess error", "unknown inputs"}.intersection(reasons):
        verdict, certain = "unexplained", {}
    elif len(rivals) > 1:
        verdict = "ambiguous"
    elif kinds:
        verdict = "effect_found" if "effect" in kinds else "sensor_error" if "sensor" in kinds else "parameter_error"
    is_part = verdict == "ambiguous" or is_misfit or misfit.remains > LITTLE
    not_excluded = {
        (rich, simple): p
        for rich, simple in bundle.families.items()
        if simple in certain and rich not in certain and (p := inclusion(sets).get(rich, 0.0)) > POSSIBLE
    }
    return Decision(
        verdict=verdict,
        grade=("part" if is_part else "claimed") if certain else "nearest",
        claimed=dict(sorted(certain.items(), key=lambda item: -item[1])),
        rivals=rivals if verdict == "ambiguous" else {},
        uncertain={n: p for n, p in numbers.items() if n not in certain and p > POSSIBLE},
        not_excluded=not_excluded,
        classes=classes,
        inclusion=numbers,
        disputed=frozenset(disputed),
        aside=frozenset(aside),
        nearest=nearest,
        dispersion=kappa,
        misfit=misfit,
        reasons=(*(f"interval: {name}" for name in sorted(withdrawn)), *reasons),
    )
