"""The verdict of a refinement, from the posterior over sets of parts: a pure function of a bundle of fits.

The evidence of a hypothesis is a Gaussian integral around the estimate θ̂, which need not be an optimum:

    ln E = ℓ/κ − ½ m'S⁻¹m + ½ b'H⁻¹b − ½ ln|S·H|      H = F/κ + S⁻¹,  b = −g/κ + S⁻¹m,  m = prior mean − θ̂

with the log-likelihood ℓ, the gradient g of −ℓ, the information F, from which the noise levels are integrated out, and
the covariance S of the prior. Priors are truncated at limits. κ is the dispersion of a composite likelihood (Varin,
Reid and Firth 2011, Statistica Sinica 21:5), the same for all hypotheses of a study. Sizes of effects have a mixture of
normal priors of several widths, so that no verdict depends on one width.
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

# Thresholds of decisions; `COUNTS_FROM` of replays is a further one.
CERTAIN = 0.95  # inclusion probability from which a part is claimed; total probability of rivals
POSSIBLE = 1.0 - CERTAIN  # probability from which a class is a rival
PART = 0.5  # factor of the prior for each further part
MIXTURE = (1 / 3, 1.0, 3.0)  # widths of the prior of a size, in usual sizes
TRIAL_TOLERANCE = 0.05  # of a base parameter that is tried and has none; least width of its prior
MISFIT = 1e-3  # probability by chance below which there is a lack of fit
UNKNOWN_INPUT = 0.02  # share of a derivative that unknown inputs may have, unless replays show the effect of a claim
LITTLE = 0.1  # share of the excess error that may remain with a complete claim
UNEXPLAINED = 0.5  # share of the excess error that may remain with any claim
CLEARLY = 0.05  # difference of log errors of predictions from which trusted equations (no unknown inputs) are better
EQUIVALENT = 1e-3  # share of an effect's response; smaller differences are due to rounding and integration

Kind = Literal["effect", "sensor", "parameter"]
Verdict = Literal["effect_found", "parameter_error", "sensor_error", "no_effect", "ambiguous", "unexplained"]
Grade = Literal["claimed", "part", "nearest"]
Names = frozenset[str]


def chance_of_gain(gain: float, count: int) -> float:
    """Return the probability that `count` parameters give a log-likelihood gain by chance, by the χ² test."""
    return float(chdtrc(count, 2.0 * np.maximum(gain, 0.0)))


@dataclass(frozen=True)
class Parameter:
    """A free parameter of a hypothesis with its prior.

    Attributes:
        part: Candidate to which the parameter belongs; "" for a base parameter that is not tried.
        centre, width: Mean and standard deviation of the prior; the deviation is infinite without a prior.
        is_size: True for a size, whose prior is a mixture of widths.
        low, high: Limits at which the prior is truncated; a size that cannot be negative has half a normal prior.
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
    """The fit of a hypothesis, by blocks of time, with noise levels integrated out.

    Attributes:
        log_likelihoods, logs: Log-likelihood of each block, and the log to which it belongs.
        gradients: Gradients of −ℓ by the parameters, shape (blocks, parameters).
        informations: Information matrix of each log, shape (logs, parameters, parameters).
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
        probability: Probability that unmodelled dynamics improve the fit as much by chance.
        beside: Part → probability when unmodelled dynamics are fitted too.
        unknown_share: Largest share of a derivative that is due to unknown inputs.
        remaining: Channel → share of the given model's excess error that remains.
        over_floor: Channel → error over the horizon, divided by the noise floor.
    """

    probability: float = 1.0
    beside: Mapping[str, float] = field(default_factory=dict)
    unknown_share: float = 0.0
    remaining: Mapping[str, float] = field(default_factory=dict)
    over_floor: Mapping[str, float] = field(default_factory=dict)

    @property
    def remains(self) -> float:
        """Return the mean share of excess error that remains; 0 if there is no excess error."""
        return float(np.mean([*self.remaining.values()])) if self.remaining else 0.0


@dataclass(frozen=True)
class Bundle:
    """All data on which the verdict of a study depends.

    Attributes:
        kinds: Candidate → kind, for all candidates.
        equivalent: Pairs of hypotheses with equal predictions for every input.
        families: Candidate → candidate that is its special case.
        hidden: Effects that the logs would not show at their usual size.
        unsure: Parts whose intervals contain the value without effect, or the value of their special case.
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
    """The verdict, with its reasons.

    Attributes:
        claimed: Part → its posterior probability.
        rivals: Rivals of an ambiguous verdict → probability, most probable first.
        uncertain: Parts that are neither claimed nor excluded → probability.
        not_excluded: (candidate, claimed special case that it may replace) → probability.
        classes: All classes → probability, most probable first.
        inclusion: Part → sum of the probabilities of classes that contain it.
        disputed: Parts that are not claimed when unmodelled dynamics are fitted too.
        aside: Parts that rivals leave out: disputed parts, and uncertain base parameters beside certain parts.
        nearest, misfit: The most probable class, and its lack of fit.
        reasons: Reasons against a claim.
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
        """Return True if a set of parts is one of the rivals."""
        return parts - self.aside in self.rivals


def dispersion(h: Evidence) -> float:
    """Return the dispersion κ ≥ 1: variance of the score divided by its information, mean over parameters."""
    if not h.parameters:
        return 1.0
    centred = h.gradients - h.gradients.mean(axis=0)
    variance = centred.T @ centred * len(centred) / max(1, len(centred) - 1)
    return max(1.0, float(np.trace(_solve(h.informations.sum(axis=0), variance))) / len(h.parameters))


def log_evidence(h: Evidence, kappa: float) -> float:
    """Return ln E, where E is the mean over the widths of the priors; sizes of one part have the same width."""
    parts = sorted({p.part for p in h.parameters if p.is_size})
    of_widths = []
    for widths in product(MIXTURE, repeat=len(parts)):
        scale = dict(zip(parts, widths, strict=True))
        of_widths.append(_log_evidence(h, kappa, [scale.get(p.part, 1.0) if p.is_size else 1.0 for p in h.parameters]))
    evidence = float(logsumexp(of_widths)) - math.log(len(of_widths))
    return evidence if math.isfinite(evidence) else -math.inf  # if the filter diverges near the estimate


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
    for p, moved, deviation, scale in zip(h.parameters, step, deviations, width, strict=True):  # truncated
        result += _log_inside(p, p.value + moved, float(deviation))
        if math.isfinite(scale):
            result -= _log_inside(p, p.centre, float(scale))
    return result


def _log_inside(p: Parameter, mean: float, deviation: float) -> float:
    """Return ln of the probability that a normal variable is within the limits of a parameter."""
    low, high = (p.low - mean) / deviation, (p.high - mean) / deviation
    if low > -high:  # both limits in the tail that is computed without cancellation
        low, high = -high, -low
    upper, lower = float(log_ndtr(high)), float(log_ndtr(low))
    return upper + math.log1p(-math.exp(min(0.0, lower - upper))) if lower < upper else -math.inf


def _solve(matrix: Array, right: Array) -> Array:
    """Return the solution of linear equations, scaled by the diagonal; if singular, the least-squares solution."""
    scale = np.sqrt(np.clip(np.diag(matrix), 0.0, None))
    scale[scale == 0.0] = 1.0
    solution = np.linalg.lstsq(matrix / np.outer(scale, scale), (right.T / scale).T, rcond=1e-12)[0]
    return np.asarray((solution.T / scale).T)


def log_prior(size: int, count: int) -> float:
    """Return ln ½ᵏ/C(N, k), the prior of k = `size` of `count` candidates (Scott, Berger 2010, Ann. Stat. 38:2587)."""
    return size * math.log(PART) - math.log(math.comb(count, size))


def posterior(hypotheses: Sequence[Evidence], count: int) -> tuple[dict[Names, float], float]:
    """Return set of parts → probability, and the dispersion, which is that of the most likely hypothesis.

    The dispersion of a poor hypothesis would include its lack of fit (Burnham and Anderson 2002, Model Selection, 2.5).

    Args:
        count: Number of candidates.
    """
    kappa = dispersion(max(hypotheses, key=lambda h: float(h.log_likelihoods.sum())))
    log_weights = {h.parts: log_evidence(h, kappa) + log_prior(len(h.parts), count) for h in hypotheses}
    total = logsumexp([*log_weights.values()])
    return {parts: math.exp(weight - total) for parts, weight in log_weights.items()}, kappa


def folded(sets: Mapping[Names, float], equivalent: Iterable[tuple[Names, Names]]) -> dict[Names, float]:
    """Return class → probability, most probable first; a class is named by its most probable set of parts.

    Equivalent sets form a class. A class is merged into its most probable subset that is more probable than the class,
    before any merging. Otherwise a part that explains nothing would keep the few per cent of its prior, and make every
    true claim uncertain.
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
    """Return sets in which special cases replace candidates that generalise them, unless these are certain.

    If the set with the special case was not fitted, the set is merged into a more probable subset, as in `folded`.

    Args:
        unsure: Candidates that their intervals do not distinguish from their special cases.
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
    """Return the verdict of a study, from its bundle."""
    sets, kappa = posterior(bundle.hypotheses, len(bundle.kinds))
    classes = folded(by_family(sets, bundle.families, bundle.unsure), bundle.equivalent)
    numbers, nearest, misfit = inclusion(classes), next(iter(classes)), bundle.misfit
    certain = {name: p for name, p in numbers.items() if p >= CERTAIN}
    withdrawn = {name for name in certain if name in bundle.unsure}
    certain = {name: p for name, p in certain.items() if name not in withdrawn}
    # if every hypothesis is wrong, posteriors mean nothing: hypotheses are then compared together with unmodelled
    # dynamics
    is_misfit = misfit.probability < MISFIT
    # a base parameter may absorb what the model lacks, even if unmodelled dynamics are fitted too
    disputed = {n for n in certain if bundle.kinds[n] == "parameter" or misfit.beside.get(n, 1.0) < CERTAIN}
    disputed = disputed if is_misfit else set()
    certain = {n: p for n, p in certain.items() if n not in disputed}
    reasons = ["misfit"] if is_misfit and not certain else []
    # unknown inputs may contain what a claim imitates, unless replays without them show its effect
    is_seen = bool(certain and misfit.remaining) and misfit.remains <= UNEXPLAINED
    if misfit.unknown_share > UNKNOWN_INPUT and not is_seen:
        reasons.append("unknown inputs")
    over = max(misfit.over_floor.values(), default=0.0) > COUNTS_FROM
    if (is_misfit and misfit.remains > UNEXPLAINED) if certain else over:
        reasons.append("excess error")
    # an uncertain base parameter beside certain parts is reported, but does not change the verdict
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
    if len(rivals) == 1:  # withdrawn parts may be missing in the remaining rival
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
