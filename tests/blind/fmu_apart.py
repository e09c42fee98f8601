"""Nats between a hidden effect of the FMUs' suite and the best replacement of it: another kind or place, or nothing.

    python -m tests.blind.fmu_apart 60 --first 7100       of the known studies among 60 seeds

What no refiner can tell apart is no fault of a refiner. As `field_cost`, this uses nothing of the project: the filter
of the true model gives the innovations with the replacement in place of the effect. Its size and shape (Gauss-Newton,
from two sizes), the base parameters within their tolerances and the study's other effect adapt. What is left is D nats.
Without a replacement, the base parameters and the other effect adapt in rounds: `costs` adapts them once, on a straight
line, and promises too much of an effect that they imitate.

A sensor's lag is never below half a row here, and a latency is read on a straight line between rows, so that D of such
effects is too large.

A difference of likelihoods scatters by √(2·D) about D. A test that refutes a true hypothesis in 1 % of all cases
tells both apart in 90 % only from D = ½·(2.33 + 1.28)² = 6.5 nats on (`APART`).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from tests.blind.field_cost import Conditions, Values, base_deviations, flat, innovations, left_out, nudge, remaining
from tests.blind.field_rig import Entry
from tests.blind.field_study import LEAST, conditions
from tests.blind.field_visibility import middling
from tests.blind.fmu_rig import FmuRig
from tests.blind.fmu_study import FmuStudy, draw
from tests.blind.fmu_truths import RIGS

APART = 6.5
AT_INPUTS = ("bias", "gain", "dead_band", "saturation", "rate_limit", "play", "lag", "second_order_lag")
AT_PAIRS = ("coulomb", "stribeck", "viscous", "quadratic_drag", "cubic_spring", "cogging")
AT_OUTPUTS = ("bias", "scale", "lag", "drift")  # and a latency where the plant may have one
KEPT = (8, 5, 5, 5)  # replacements that are adapted further, round by round
ROUNDS = 4  # in which base parameters and the other effect adapt
NOTHING = "nothing"
SHARE, SMALLEST = 0.05, 0.02  # step of a difference; size to which a round may shrink a replacement without sign


@cache
def with_every_kind(plant: str, way: str) -> FmuRig:
    """Return a plant that may have each kind of effect at each place, as the general catalogue has."""
    cls = type(RIGS[plant, way])
    inputs = {n: replace(u, kinds=AT_INPUTS) if u.kinds else u for n, u in cls.plants_inputs.items()}
    pairs = {n: replace(v, kinds=AT_PAIRS) for n, v in cls.pairs.items()}
    outputs = {
        n: replace(y, kinds=(*AT_OUTPUTS, *{"latency"}.intersection(y.kinds))) for n, y in cls.plants_outputs.items()
    }
    return type(cls.__name__, (cls,), {"plants_inputs": inputs, "pairs": pairs, "plants_outputs": outputs})(way)


def nearest(study: FmuStudy) -> dict[str, tuple[str, float]]:
    """Return effect → the replacement that is nearest to it, or NOTHING, and the nats that it leaves."""
    return {
        name: min(_nearest(study, name), (NOTHING, _without(study, name)), key=lambda pair: pair[1])
        for name in study.truth
    }


def can_be_told(study: FmuStudy) -> bool:
    """Return whether every effect can be told from its replacements, and seen at all."""
    seen = all(_without(study, name) >= LEAST for name in study.truth)
    return seen and all(_nearest(study, name)[1] >= APART for name in study.truth)


def _without(study: FmuStudy, name: str) -> float:
    """Return the nats that are left without an effect, once base parameters and the other effect have adapted."""
    rig, given = study.rig, conditions(study)
    p, spread = rig.numbers(study.base, study.truth), base_deviations(rig)
    others = {n: v for n, v in study.truth.items() if n != name}
    steps = {n: 0.5 * deviation for n, deviation in spread.items()}
    steps |= {f"{n}.{q}": nudge(rig, n, q, v) for n, values in others.items() for q, v in values.items()}
    moved, least = dict.fromkeys(steps, 0.0), np.inf
    prior = np.array([0.5 if n in spread else 0.0 for n in steps])  # standard deviations of a step
    for _ in range(ROUNDS):
        now = p | flat(name, left_out(rig, name, study.truth[name]))
        now |= {n: p[n] + moved[n] * step for n, step in steps.items()}
        white = innovations(rig, p, [now, *(now | {n: now[n] + step} for n, step in steps.items())], given)
        if not np.isfinite(white).all():
            break
        at = np.array([*moved.values()])
        least = min(least, 0.5 * float(white[:, 0] @ white[:, 0] + np.sum((prior * at) ** 2)))
        rows = np.vstack([white[:, 1:] - white[:, :1], np.diag(prior)])
        change = np.linalg.lstsq(rows, -np.append(white[:, 0], prior * at))[0]
        moved = dict(zip(steps, at + change, strict=True))
    return least


def _nearest(study: FmuStudy, name: str) -> tuple[str, float]:
    rig = with_every_kind(study.plant, study.way)
    p, spread = rig.numbers(study.base, study.truth), base_deviations(rig)
    without = {q: v for q, v in p.items() if q.partition(".")[0] != name}  # a neutral limit would limit a gain
    others = {n: v for n, v in study.truth.items() if n != name}
    common = [p | {n: p[n] + 0.5 * deviation} for n, deviation in spread.items()]
    common += [p | {f"{n}.{q}": v + nudge(rig, n, q, v)} for n, values in others.items() for q, v in values.items()]
    rivals = [
        (other, _sizes(rig.entries[other], middling(rig, other, share)[0]))
        for other in sorted(set(rig.entries) - set(study.truth))
        for share in (0.2, 1.0)
    ]
    rivals += _as_large(rig, p, without, rivals[::2], conditions(study))
    best = ("", np.inf)
    for kept in (*KEPT, 0):
        cases, first = [*common], []
        for other, sizes in rivals:
            first.append(len(cases))
            moved = [sizes, *(sizes | {q: s + _step(s)} for q, s in sizes.items())]
            cases += [without | flat(other, _values(rig.entries[other], m)) for m in moved]
        white = innovations(rig, p, cases, conditions(study))
        base = white[:, : len(common)].copy()
        base[:, : len(spread)] *= 2.0  # of one standard deviation
        ahead = []
        for (other, sizes), k in zip(rivals, first, strict=True):
            what, moves = white[:, k], white[:, k + 1 : k + 1 + len(sizes)] - white[:, k : k + 1]
            if not (np.isfinite(what).all() and np.isfinite(moves).all()):
                continue
            best = min(best, (other, 0.5 * remaining(what, base, len(spread))), key=lambda pair: pair[1])
            free = np.column_stack([base, moves])
            change = _adapted(what, free, len(spread))[len(common) :]
            promised = 0.5 * remaining(what, free, len(spread))
            ahead.append((promised, other, _moved(rig.entries[other], sizes, change)))
        ahead.sort(key=lambda entry: entry[0])
        rivals = [(other, sizes) for _, other, sizes in ahead[:kept]]
    return best


def _as_large(
    rig: FmuRig, p: Values, without: Values, rivals: Sequence[tuple[str, Values]], given: Conditions
) -> list[tuple[str, Values]]:
    """Return replacements at sizes that change the innovations about as much as the effect does."""
    cases = [without | flat(other, _values(rig.entries[other], sizes)) for other, sizes in rivals]
    missing, *changed = innovations(rig, p, [without, *cases], given).T
    scaled = []
    for (other, sizes), white in zip(rivals, changed, strict=True):
        change = float(np.linalg.norm(white - missing))
        if np.isfinite(change) and change > 0.0:
            times, shape = float(np.linalg.norm(missing)) / change, rig.entries[other].shape
            scaled.append((other, {q: s if q in shape else times * s for q, s in sizes.items()}))
    return scaled


def _adapted(what: np.ndarray, free: np.ndarray, with_prior: int) -> np.ndarray:
    """Return the multiples of `free` that leave least of `what`; the first have a standard normal prior."""
    scale = np.sqrt(np.sum(free**2, axis=0)) + 1e-300
    rows = np.vstack([free, np.eye(with_prior, free.shape[1])]) / scale
    return np.asarray(-np.linalg.lstsq(rows, np.append(what, np.zeros(with_prior)))[0] / scale)


def _step(size: float) -> float:
    return SHARE * abs(size) or 1e-9


def _sizes(entry: Entry, values: Mapping[str, float]) -> Values:
    """Return the distances of parameters from neutral, inverted where a larger parameter is a smaller effect."""
    return {q: v if q in entry.shape else 1.0 / v if entry.inverse else v - entry.neutral for q, v in values.items()}


def _values(entry: Entry, sizes: Mapping[str, float]) -> Values:
    return {q: s if q in entry.shape else 1.0 / s if entry.inverse else s + entry.neutral for q, s in sizes.items()}


def _moved(entry: Entry, sizes: Values, change: Sequence[float]) -> Values:
    """Return sizes after a change in steps, within the limits and on the side of an effect without sign."""
    moved = {}
    for (q, s), steps in zip(sizes.items(), change, strict=True):
        to = s + float(steps) * _step(s)
        if q in entry.shape:
            to = float(np.clip(to, *entry.shape[q]))
        elif entry.signed:
            to = float(np.clip(to, -entry.limits[1], entry.limits[1]))
        else:
            to = max(to, SMALLEST * s) if s > 0.0 else min(to, SMALLEST * s)
        moved[q] = to
    return moved


def table(seeds: Sequence[int]) -> str:
    """Return a line for each effect of the known studies, then how many can be told apart, by size."""
    lines, found = [], dict[str, list[float]]()
    for study in filter(lambda s: s.kind == "known", map(draw, seeds)):
        each = nearest(study)
        found.setdefault(study.size, []).append(min(d for _, d in each.values()))
        told = "; ".join(f"{n} ({study.costs[n]:.0f} nats): {other} leaves {d:.2f}" for n, (other, d) in each.items())
        lines.append(f"{study.seed} {study.plant} {study.way} {study.size}: {told}")
    for size, nats in sorted(found.items()):
        lines.append(f"{size}: {sum(d >= APART for d in nats)} of {len(nats)} studies can be told apart, {APART} nats")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.blind.fmu_apart", description=__doc__.splitlines()[0])
    parser.add_argument("count", type=int, metavar="N", help="how many seeds")
    parser.add_argument("--first", type=int, default=0, help="the first of them")
    options = parser.parse_args(arguments)
    print(table(range(options.first, options.first + options.count)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
