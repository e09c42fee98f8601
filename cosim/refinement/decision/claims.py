"""`Claims`: the claims of a study, with the data for its report, and their sentences.

Each sentence names at most three things; refine.json and the report list all of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cosim.core.arrays import NamedValues
from cosim.core.text import MAX_NAMED, amount, append_unit, display, join_names, percent, plain, written
from cosim.estimation.fit import Fit
from cosim.estimation.problem import Problem
from cosim.estimation.subject.candidates import SIGMAS_PER_TOLERANCE, Candidate, Free, kind_within
from cosim.estimation.subject.interface import Subject
from cosim.logs.log import NORMAL_95
from cosim.refinement.decision.bundle import (
    beside_unnamed_terms,
    bundle_of,
    chance_of,
    drifts,
    fit_given_model,
    fits_without_each_log,
    held_out_errors,
    misfit_of,
    noise_gains,
    sizes_of,
    with_intervals,
)
from cosim.refinement.decision.posterior import (
    CERTAIN,
    LITTLE,
    MISFIT,
    Bundle,
    Decision,
    Grade,
    Names,
    Verdict,
    decide,
    log_evidence,
    log_prior,
)
from cosim.refinement.proof.measure import (
    FLOOR_SEED,
    Variant,
    log_noise,
    noise_floor,
    predicted_errors,
    refined_variant,
    variant_of,
)
from cosim.refinement.search.fits import TOGETHER, Hypothesis, Progress, Search
from cosim.refinement.search.unnamed import Leftover, UnnamedTerm, find_unnamed_terms, signal_units, unknown_inputs
from cosim.refinement.study import Study
from cosim.residuals.residual_statistics import COUNTS_FROM

DEFAULT_EXPERIMENT = "larger and broader commands on all inputs, one at a time and together"
NO_EFFECT = "no_effect"
NOTHING_MISSING = "Nothing is missing: the model, recalibrated, explains these logs down to the sensors' noise."
DISTURBED = "Nothing is missing: what the model does not explain is a disturbance that follows no signal."
OPENINGS = {"effect": "the model lacks", "parameter": "the model has a wrong", "sensor": "the sensors have"}


@dataclass(frozen=True, eq=False)
class Claims:
    """The claims of a study, and the data for its report."""

    bundle: Bundle  # what the decision depends on
    decision: Decision
    base: Hypothesis  # the recalibrated model
    claimed: Hypothesis | None  # delivered as refined model, with intervals; None without a claim
    nearest: Hypothesis | None  # delivered as nearest model; None for the given model or a complete claim
    tried: Sequence[tuple[Hypothesis, float]]  # with log posterior odds relative to the recalibrated model, best first
    experiment: str  # input that separates the rivals
    equivalent: Sequence[Sequence[str]]  # groups of names with equal predictions for every input
    residual: Mapping[str, Any]  # deficient equation, its signals and process noise
    unnamed: Sequence[UnnamedTerm]  # unmodelled dynamics, most likely first
    moves: NamedValues  # forced state → size of its unknown input relative to its derivative
    hidden: Sequence[str]  # effects that these logs cannot show
    ladder: Sequence[tuple[Hypothesis | None, Any]]  # models, given one first; log errors on held-out logs

    @property
    def name(self) -> Verdict:
        """Return the verdict."""
        return self.decision.verdict

    @property
    def grade(self) -> Grade:
        """Return the grade: claimed, part or nearest."""
        return self.decision.grade

    @property
    def best(self) -> Hypothesis:
        """Return the hypothesis of the most probable class."""
        return next(h for h, _ in self.tried if h.key == self.decision.nearest)

    @property
    def delivered(self) -> Hypothesis:
        """Return the delivered hypothesis: claim, else nearest model, else recalibrated model."""
        return self.claimed or self.nearest or self.base

    @property
    def claimed_candidates(self) -> tuple[Candidate, ...]:
        """Return the claimed candidates, sorted by their probability alone."""
        if self.claimed is None:
            return ()
        alone = {h.key: odds for h, odds in self.tried}
        claimed = [c for c in self.claimed.candidates if c.name in self.decision.claimed]
        return tuple(sorted(claimed, key=lambda c: -alone.get(frozenset({c.name}), -math.inf)))

    @property
    def rivals(self) -> tuple[str, ...]:
        """Return the names of rivals of an ambiguous verdict; `a + b` is a set of two parts."""
        return tuple(text_of(parts) for parts in self.decision.rivals)


def text_of(parts: Names) -> str:
    """Return the name of a set of parts, such as `a + b`."""
    return TOGETHER.join(sorted(parts)) or NO_EFFECT


def sentence(c: Claims, subject: Subject, risen: Mapping[str, tuple[float, float]], remaining: NamedValues) -> str:
    """Return the verdict as text: answer, rise of errors on sealed logs, remaining error, remarks.

    Args:
        risen: Channel → error before and after, for errors that rise significantly on sealed logs.
        remaining: Channel → share of the squared error above the noise floor that remains on sealed logs.
    """
    answer, *details = filter(None, _answer_texts(c, subject))
    rises = []  # whose rounded values differ
    for name, pair in risen.items():
        before, after = (error_text(subject, name, error) for error in pair)
        rises += [f"of {name} from {before} to {after}"] if before != after else []
    model = "nearest" if c.claimed is None else "refined"
    rise = f"On the sealed logs the error of the {model} model rises: {join_names(rises)}." if rises else ""
    return " ".join(filter(None, (answer, rise, *details, *_remark_texts(c, remaining))))


def _answer_texts(c: Claims, subject: Subject) -> Iterator[str]:
    """Yield sentences on the verdict; the first one can be read alone."""
    reasons, rivals = c.decision.reasons, c.decision.rivals
    claim, *details = _claim_texts(c, c.claimed, subject) if c.claimed is not None else ("",)
    if c.name == "ambiguous":
        names = join_names(c.hidden)
        weak = [f"these logs have too little excitation to detect {names}."]
        parts = [reason.removeprefix("interval: ") for reason in reasons if reason.startswith("interval: ")]
        refusals = [f"the intervals of {join_names(parts)} contain the values without effect."] if parts else []
        undecided = [_rivals_text(c)] if not refusals or sum(p > 0.0 for p in rivals.values()) > 1 else []
        first, *others = weak if "nothing would show" in reasons else [*undecided, *refusals]
        yield _joined(claim, first)
        yield from (_joined("", text) for text in others)
        yield f"An experiment that may decide: {c.experiment}." if c.experiment else ""
    elif c.name == NO_EFFECT:
        sizes = [f"{percent(share)} of the derivative of {name}" for name, share in c.moves.items()]
        yield f"{DISTURBED} Its size: {join_names(sizes)}." if sizes else NOTHING_MISSING
        if c.hidden:
            yield f"These logs have too little excitation to detect {join_names(c.hidden)}."
        moved = [
            f"{f.name} {plain(f.prior[0])} → {plain(c.base.fit.values[f.name])}"
            for f in c.base.fit.free
            if f.prior and abs(c.base.fit.values[f.name] - f.prior[0]) > SIGMAS_PER_TOLERANCE * f.prior[1]
        ]
        if moved:
            yield f"This requires base parameters outside their tolerances: {join_names(moved)}."
    elif c.name == "unexplained":
        yield f"No effect was confirmed: {_unexplained_text(c)}."
        if c.decision.nearest:
            yield f"Most probable, but not claimed: {join_names(sorted(c.decision.nearest))}."
    else:
        yield claim
    yield from details


def _joined(first: str, second: str) -> str:
    """Return two sentences joined to one."""
    text = f"{first.removesuffix('.')}; {second}" if first and second else first or second
    return f"{text[:1].upper()}{text[1:]}"


def _claim_texts(c: Claims, best: Hypothesis, subject: Subject) -> list[str]:
    """Return sentences on claimed candidates with values and intervals."""
    values = {k.name: [_estimate_text(best, f, subject) for f in k.free] for k in c.claimed_candidates}
    is_long = sum(map(len, values.values())) > MAX_NAMED
    parts = []
    for kind, opening in OPENINGS.items():
        names = [k.name for k in c.claimed_candidates if kind_within(k, subject) == kind]
        texts = names if is_long else [f"{name} ({', '.join(values[name])})" for name in names]
        parts += [f"{opening} {join_names(texts)}"] if names else []
    each = [f"{name}: {', '.join(estimates)}." for name, estimates in values.items()] if is_long else []
    if not best.fit.converged:
        each.append("The fit did not converge: these intervals are too narrow.")
    return [f"{_joined('', '; '.join(parts))}.", *each]


def _estimate_text(best: Hypothesis, f: Free, subject: Subject) -> str:
    """Return an estimate with its 95 % interval, or a text if the interval is wider than the allowed range."""
    name, value, half = f.name.rpartition(".")[2], best.fit.values[f.name], NORMAL_95 * best.fit.sigma(f.name)
    unit = written(subject.declared[f.name].unit)
    if half > f.high - f.low:
        return f"{name} not identified by these logs"
    if region := best.fit.regions.get(f.name):
        low, high = (f"{limit:.2g} {unit}".rstrip() for limit in region)
        if region[0] <= f.low:
            return f"{name} at most {high}"
        return f"{name} at least {low}" if region[1] >= f.high else f"{name} between {low} and {high}"
    return f"{name} = {rounded(value, half)} ± {plain(half, 2)} {unit}".rstrip()


def rounded(value: float, half: float) -> str:
    """Return a number, rounded to two digits of the half-width of its interval."""
    if not (value and half and math.isfinite(half)):
        return f"{value:g}"
    return f"{value:.{max(2, math.ceil(math.log10(abs(value) / half)) + 2)}g}"


def _rivals_text(c: Claims) -> str:
    """Return a sentence on the rivals."""
    rivals = c.decision.rivals
    common = frozenset[str].intersection(*rivals)
    names = {parts: join_names(sorted(parts - common)) or "nothing more" for parts in rivals}
    chances = [f"{name} ({percent(rivals[parts])})" for parts, name in names.items()]
    if len(names) > 2:
        return f"these logs cannot decide between {join_names(chances)}."
    if common in rivals:
        (doubtful,) = (chance for chance, parts in zip(chances, names, strict=True) if parts != common)
        return f"these logs decide neither for nor against {doubtful}."
    return f"these logs cannot tell {chances[0]} from {chances[1]}."


def _unexplained_text(c: Claims) -> str:
    """Return a sentence on the remaining error: the equation and the signal it depends on, or its size."""
    over = c.decision.misfit.over_floor
    channel = max(over, key=lambda n: over[n], default="")
    if text := _misfit_text(c):
        return text
    if "unknown inputs" in c.decision.reasons:
        name = max(c.moves, key=lambda n: c.moves[n])
        return f"a disturbance of {percent(c.moves[name])} of the derivative of {name} remains and follows no signal"
    if over.get(channel, 0.0) <= COUNTS_FROM:
        return "unmodelled dynamics remain, but follow no stable pattern"
    if math.isinf(over[channel]):
        return f"with the most probable hypothesis, replays of {channel} diverge"
    return (
        f"with the most probable hypothesis, the error of {channel} is {plain(over[channel], 2)} times its noise floor"
    )


def _misfit_text(c: Claims) -> str:
    """Return a phrase on the signals on which the remaining error depends; "" if there are none."""
    where, share, changing = c.residual["equation"], c.residual["share"], [*c.residual["changing"]]
    if not c.residual["signals"]:
        return f"the remaining error varies as if {join_names(changing)} changed during each log" if changing else ""
    first = c.unnamed[0]
    signal, shape = first.signal, first.shape
    part = f"{percent(share)} of the" if share and share > 0.0 else "the"
    text = f"{part} remaining error{f' of {where}' if where else ''}"
    if shape is None:
        return f"{text} is constant" if signal == "1" else f"{text} follows {signal}"
    if first.like:
        return f"{text} follows {signal}, as {first.like} would"
    place, width = amount(shape.place, shape.unit), amount(shape.width, shape.unit, 2)
    by = f", times {shape.factor}" if shape.factor else ""
    if shape.kind == "spline":
        return f"{text} depends on {signal}{by}, but not as a step, a wave or another simple function"
    if shape.kind == "step" and abs(shape.place) < shape.width:
        like = ", as dry friction would" if shape.unit in {"m/s", "rad/s"} and not by else ""
        return f"{text} follows the sign of {signal}{by}{like}"
    ways = {"step": f" and changes at {place}", "wave": f" and repeats every {width}"}
    return f"{text} follows {signal}{ways.get(shape.kind, f', mainly near {place} (width {width})')}{by}"


def _remark_texts(c: Claims, remaining: NamedValues) -> Iterator[str]:
    """Yield sentences on the error that a claim or the nearest model leaves, and further remarks."""
    misfit = c.decision.misfit
    if c.decision.disputed and c.name != "unexplained":
        disputed = join_names(sorted(c.decision.disputed))
        yield f"Not claimed, because unmodelled dynamics remain: {disputed}."
    is_lacking = misfit.probability < MISFIT or not c.residual["signals"]
    if c.claimed is not None and is_lacking and (text := _misfit_text(c)):
        yield f"{_joined('', text)}."
    if c.grade == "part" and c.name != "ambiguous" and misfit.remains > LITTLE:
        channel = max(misfit.remaining, key=lambda n: misfit.remaining[n])
        rest = percent(misfit.remaining[channel]) if misfit.remaining[channel] < 1.0 else "all"
        yield f"In replays, {rest} of the error of {channel} above the noise floor remains."
    if remaining:
        share = sum(remaining.values()) / len(remaining)
        who = "The recalibrated model" if c.name == NO_EFFECT else "The nearest model"
        if c.claimed is not None:
            who = "The most probable of these" if c.name == "ambiguous" else "The claim"
        removes = percent(1.0 - share) if share < 1.0 else "nothing"
        yield f"{who} removes {removes} of the given model's squared error above the noise floor on sealed logs."
    for names in c.equivalent:
        yield f"{' or '.join(names)}: no input can separate these {'two' if len(names) == 2 else len(names)}."
    for (rich, simple), probability in c.decision.not_excluded.items():
        yield f"These logs do not exclude {rich} in place of {simple} (probability {percent(probability)})."
    if c.grade != "claimed" and c.name != NO_EFFECT:
        more = "" if c.nearest is None else ", recalibrated"
        if c.nearest is not None and c.nearest.names:
            more = f" with {join_names(c.nearest.names)}"
        yield (
            "The nearest model is the most probable one that predicts held-out logs no worse than the given model: the "
            f"given model{more}."
        )


def error_text(subject: Subject, channel: str, error: float) -> str:
    """Return an error of a channel as text."""
    unit, factor = display(next((q.unit for q in subject.outputs if q.name == channel), ""))
    return append_unit(plain(error * factor), unit)


# From hypotheses to claims: bundle, lack of fit, decision, and choice of the delivered model.


MAX_LADDER_CLASSES = 3  # classes on the ladder of predictions
TESTS = 2  # of the fit: for terms without a name, and for parameters that change


def claims_of(study: Study, search: Search, progress: Progress) -> Claims:
    """Return the claims of a study."""
    subject, bundle = study.subject, bundle_of(search)
    first = decide(bundle)
    base, best = search.tried[frozenset()], search.tried[first.nearest]
    units = signal_units(subject)
    progress("searching for unmodelled dynamics", 0.0)
    kernel = subject.kernel(search.problem.layout.outputs, unnamed=True, constant=study.settings.per_log)
    values = {**dict.fromkeys(kernel.layout.parameters, 0.0), **search.problem.values}
    nameless = replace(search.problem, kernel=kernel, values=values, sensing=best.fit.noise)
    leftover = find_unnamed_terms(nameless, best.fit, units)
    by_chance = TESTS * chance_of(nameless, leftover, best.fit)
    leftover = leftover if by_chance < MISFIT else Leftover()
    changing = {name: (change, TESTS * p) for name, (change, p) in drifts(search.problem, best.fit).items()}
    by_chance = min(1.0, by_chance, *(p for _, p in changing.values()))
    residual = _residual(search.problem, base.fit, best.fit, leftover)
    residual["changing"] = {name: change for name, (change, p) in changing.items() if p < MISFIT}
    inflated = [name for name, entry in residual["process_noise"].items() if entry["inflated"]]
    moves = {n: share for n, share in unknown_inputs(search.problem, best.fit, units).items() if n in inflated}
    progress("replaying with and without the claim", 0.0)
    beside = {}
    if leftover.fit is not None and best.candidates:
        beside = beside_unnamed_terms(search, best, leftover.fit, first.dispersion, len(bundle.kinds))

    def refined(f: Fit) -> Variant:
        return refined_variant(search, replace(best, fit=f))

    logs, unfitted = study.logs, fit_given_model(search.problem, base.fit)
    given = variant_of(search, subject, unfitted)
    errors = {
        "before": predicted_errors([given] * len(logs), search.problem, logs),
        "after": predicted_errors([*map(refined, fits_without_each_log(search, best))], search.problem, logs),
    }
    quiet = replace(refined(best.fit), noise=log_noise(best.fit.noise, search.free_noise))
    floor = noise_floor(quiet, search.problem, logs, np.random.default_rng(FLOOR_SEED))
    misfit = misfit_of(by_chance, moves, errors, floor, beside)
    claimed = None
    if max(first.inclusion.values(), default=0.0) >= CERTAIN:
        claimed = with_intervals(search, best)
        bundle = replace(bundle, unsure=frozenset(_unsure(search, claimed, bundle.families)))
    bundle = replace(bundle, misfit=misfit)
    decision = decide(bundle)
    tried = _ranked(search, bundle, decision.dispersion)
    delivered = _delivered(decision, [h for h, _ in tried])
    if claimed is None or delivered is None or delivered.key != claimed.key:
        claimed = with_intervals(search, delivered) if delivered else None
    shown = [search.tried[parts] for parts in [*decision.classes][:MAX_LADDER_CLASSES] if parts]
    every = {h.key: h for h in [*shown, *([claimed] if claimed else [])]}
    models = (None, base, *sorted(every.values(), key=lambda h: len(h.names)))
    ladder = [(h, held_out_errors(search, h, base.fit)) for h in models]  # by fits to the other logs
    nearest = None
    if decision.grade != "claimed":  # the most probable class that predicts held-out logs no worse than the given model
        most = float(np.mean(ladder[0][1]))
        better = {h.key: h for h, error in ladder if h is not None and float(np.mean(error)) <= most}
        nearest = next((better[parts] for parts in decision.classes if parts in better), better.get(frozenset()))
    experiment, rivals = "", tuple(decision.rivals)
    if rivals:  # parts that all rivals share need no experiment
        names = frozenset[str]().union(*rivals) - frozenset[str].intersection(*rivals)
        shared, text = max(((len(row & names), text) for row, text in subject.told_apart_by.items()), default=(0, ""))
        experiment = text if shared > 1 else DEFAULT_EXPERIMENT
    alike: dict[str, list[str]] = {}  # sets without their common parts
    for one, other in bundle.equivalent:
        own, other_names = text_of(one - other), text_of(other - one)
        alike.setdefault(own, [own]).append(other_names)
    return Claims(
        bundle=bundle,
        decision=decision,
        base=base,
        claimed=claimed,
        nearest=nearest,
        tried=tried,
        experiment=experiment,
        equivalent=[*alike.values()],
        residual=residual,
        unnamed=leftover.terms,
        moves=moves,
        hidden=[name for name in search.hidden if name not in decision.claimed],
        ladder=ladder,
    )


def _delivered(decision: Decision, ranked: Sequence[Hypothesis]) -> Hypothesis | None:
    """Return the most probable hypothesis that has all claimed parts and, apart from base parameters, no others.

    Args:
        ranked: Hypotheses, most probable first.
    """
    claimed = frozenset(decision.claimed)
    if not claimed:
        return None
    nearest = next(h for h in ranked if h.key == decision.nearest)
    if decision.verdict == "ambiguous" and claimed <= decision.nearest:
        return nearest  # the claimed parts alone may fit worse than the given model
    numbers = {n for n in decision.uncertain if decision.verdict != "ambiguous"} - decision.disputed
    suited = (h for h in ranked if h.ended and claimed <= h.key <= claimed | numbers)
    return next(suited, nearest)


def _unsure(search: Search, h: Hypothesis, families: Mapping[str, str]) -> Iterator[str]:
    """Yield the parts of a hypothesis whose sizes all have intervals that contain the value without effect.

    A part that generalises another one by a difference of two parameters is unsure if the interval of this difference
    contains 0.
    """
    for c in h.candidates:
        above = [f for f in c.free if f.above] if c.name in families else []
        ends = [(h.fit.values[f.name] - h.fit.values[f.above], h.fit.sigma(f.name, f.above)) for f in above]
        if above and all(difference < NORMAL_95 * sigma for difference, sigma in ends):
            yield c.name
        sizes = sizes_of(search, h, c)
        intervals = [h.fit.interval(p.name) for p in sizes]
        if sizes and all(low <= p.centre <= high for p, (low, high) in zip(sizes, intervals, strict=True)):
            yield c.name


def _ranked(search: Search, bundle: Bundle, kappa: float) -> list[tuple[Hypothesis, float]]:
    """Return the hypotheses with log odds relative to the recalibrated model, most probable first.

    A hypothesis without evidence, because its fit was short or stopped far from the optimum, has odds from its score.
    """
    count, base = len(bundle.kinds), search.tried[frozenset()]
    weights = {e.parts: log_evidence(e, kappa) + log_prior(len(e.parts), count) for e in bundle.hypotheses}
    zero = weights[frozenset()]
    every = [(h, weights.get(h.key, zero + (base.score - h.score) / kappa)) for h in search.tried.values()]
    return [(h, weight - zero) for h, weight in sorted(every, key=lambda pair: -pair[1])]


def _residual(problem: Problem, base: Fit, best: Fit, leftover: Leftover) -> dict[str, Any]:
    """Return the entry `residual`: deficient equation, signals on which the residual depends, process noise."""
    densities = zip(problem.layout.forced, base.noise.density, best.noise.density, strict=False)
    noise = {
        equation: {
            "before": float(before),
            "after": float(after),
            "inflated": gain > problem.price,
            "gain": gain,
        }
        for (equation, before, after), gain in zip(densities, noise_gains(problem, best), strict=True)
    }
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
