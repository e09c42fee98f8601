"""Studies of the field half, drawn by seed: plant, kind, effects and sizes, base parameters, recorder, pushes.

Plants alternate; kinds, numbers of effects and sizes of the disturbance come from shuffled decks. The size of an effect
is chosen so that the true model without it loses a randomly drawn log-likelihood (`field_cost`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from tests.blind.field_cart import Cart
from tests.blind.field_cost import Conditions, costs
from tests.blind.field_craft import CraftRig, craft, fly_craft
from tests.blind.field_drive_train import DriveTrain
from tests.blind.field_quarter_car import QuarterCar
from tests.blind.field_recorder import Recorder
from tests.blind.field_rig import Course, Entry, Rig, Run, Truth, coloured
from tests.blind.field_tanks import Tanks
from tests.blind.truth_outside import OUTSIDE

RIGS: dict[str, Rig] = {rig.name: rig for rig in (CraftRig(), DriveTrain(), Tanks(), Cart(), QuarterCar())}
PLANTS = tuple(RIGS)
LOGS = ("e1", "e2", "v1")
BLOCK = ("known",) * 11 + ("nothing",) * 5 + ("outside",) * 4  # of twenty consecutive seeds, in shuffled order
COUNTS = (1, 2, 3, 4)  # effects of a known study
DISTURBANCES = {"small": 0.0005, "large": 0.002}  # of the actuator's range: standard deviation
LEAST = 20.0  # nats: what an effect costs at least where it is left out
SMALL, LARGE = (25.0, 100.0), (100.0, 1600.0)  # nats, log-uniform
SMALL_SHARE = 0.38  # of the effects that are sized; the others, latencies, are always large
NEAR = 0.15  # share of a size to which the search goes
OUTSIDE_COST = (200.0, 1600.0)  # nats


@dataclass(frozen=True)
class Deal:
    """Properties of a seed from the shuffled decks."""

    seed: int
    plant: str
    kind: str  # known, nothing, outside
    effects: int
    disturbance: str


@dataclass(frozen=True)
class Study:
    """Answer of a study: hidden effects and recorder; `costs` [nats] of the effects."""

    seed: int
    plant: str
    kind: str
    truth: Truth
    base: dict[str, float]
    disturbance: str
    recorder: Recorder
    stamp_error: float
    costs: dict[str, float]

    @property
    def rig(self) -> Rig:
        """Return the plant."""
        return RIGS[self.plant]

    @property
    def faults(self) -> tuple[str, ...]:
        """Return the faults of the recorder, and `late` for a late sensor, which is also part of the truth."""
        late = any(self.rig.sensors[name].kind == "late" for name in self.truth if name in self.rig.sensors)
        return (*self.recorder.faults, "late") if late else self.recorder.faults


def stream(seed: int, *purpose: int) -> np.random.Generator:
    """Return an independent random stream for a purpose of a seed."""
    return np.random.default_rng([60493, seed, *purpose])


def card(deck: tuple[Any, ...], number: int, purpose: int) -> Any:
    """Return card `number` of an endless pile of equal decks, each shuffled separately."""
    pile, card = divmod(number, len(deck))
    return deck[stream(pile, purpose).permutation(len(deck))[card]]


def deal(seed: int) -> Deal:
    """Return the properties of a seed from the decks, without effects and sizes."""
    block, place = divmod(seed, len(BLOCK))
    order = [BLOCK[k] for k in stream(block, 1).permutation(len(BLOCK))]
    kind = order[place]
    number = block * BLOCK.count(kind) + order[:place].count(kind)
    count = card(COUNTS, number, 2) if kind == "known" else int(kind == "outside")
    return Deal(seed, PLANTS[seed % len(PLANTS)], kind, count, card(tuple(DISTURBANCES), seed, 3))


def base_numbers(rig: Rig, rng: np.random.Generator) -> dict[str, float]:
    """Return base parameters: nominal·(1 + N(0, tolerance/2)), truncated at the tolerance."""
    drawn = {}
    for name, (value, tolerance) in rig.sheet.items():
        away = math.inf
        while abs(away) > tolerance:
            away = float(rng.normal(0.0, 0.5 * tolerance))
        drawn[name] = value * (1.0 + away)
    return drawn


def draw(seed: int) -> Study:
    """Return the study of a seed, reproducible byte for byte."""
    dealt = deal(seed)
    rng = stream(seed, 4)
    study = bare(seed, dealt.plant, rng, dealt.kind)
    if dealt.kind == "known":
        return _hidden(study, rng, dealt.effects)
    if dealt.kind == "outside":
        return _strange(study, rng)
    return study


def bare(seed: int, plant: str, rng: np.random.Generator, kind: str = "known") -> Study:
    """Return a study with base parameters, disturbance and recorder, but without hidden effects.

    Args:
        kind: `known`, `nothing` or `outside`, the label of what is hidden later.
    """
    rig = RIGS[plant]
    longest_hole = min(90, int(0.45 / rig.step)) if rig.step < 0.05 else 9
    recorder = Recorder.draw(rng, list(rig.outputs), longest_hole)
    disturbance = card(tuple(DISTURBANCES), seed, 3)
    study = Study(seed, plant, kind, {}, base_numbers(rig, rng), disturbance, recorder, 0.0, {})
    if recorder.timing:
        study = replace(study, stamp_error=recorder.stamp_error(rig, course(study, 0)[1].readings))
    return study


# -- how it moves ------------------------------------------------------------------------------------------


def course(study: Study, number: int) -> tuple[Run, Course]:
    """Return log `number`: its inputs, and the readings of correct sensors without noise."""
    rig, recorder = study.rig, study.recorder
    manoeuvre, pushed, clock = (stream(study.seed, 10 + number, purpose) for purpose in range(3))
    sizes = [DISTURBANCES[study.disturbance] * reach for reach in rig.pushes]
    pushes = coloured(pushed, rig.rows, sizes, rig.step, rig.correlation_time)
    times = recorder.times(clock, rig.rows, rig.step)
    if isinstance(rig, CraftRig):
        made = craft(study.base, study.kind, study.truth)
        return fly_craft(rig, made, study.truth, manoeuvre, times, pushes, noise(study, number))
    run = Run(times, rig.drive(manoeuvre), pushes, rig.begin(manoeuvre))
    return run, rig.course(rig.numbers(study.base, study.truth), run)


def noise(study: Study, number: int) -> np.ndarray:
    """Return the noise of the sensors, shape (rows, outputs)."""
    white = stream(study.seed, 10 + number, 3).standard_normal((study.rig.rows, len(study.rig.outputs)))
    return white * study.recorder.deviations(study.rig)


def rows_to_keep(study: Study, number: int) -> np.ndarray:
    """Return which cells of a log are recorded, shape (rows, outputs)."""
    return study.recorder.rows_to_keep(stream(study.seed, 10 + number, 4), study.rig.rows, len(study.rig.outputs))


# -- how large it is ---------------------------------------------------------------------------------------


@dataclass
class _Sized:
    """An effect in the search for the size of a wanted cost; `known` holds tried sizes with their costs."""

    entry: Entry
    unit: dict[str, float]
    size: float
    wanted: float
    known: list[tuple[float, float]] = field(default_factory=list)

    def learn(self, cost: float) -> float:
        """Return the next size to try, within the limits, from a power law of the cost, at first the square."""
        if self.entry.fixed:
            return self.size
        power = 2.0
        if self.known and abs(math.log(self.size / self.known[-1][0])) > 1e-3:
            size, before = self.known[-1]
            power = math.log(max(cost, 1e-3) / max(before, 1e-3)) / math.log(self.size / size)
        self.known.append((self.size, cost))
        factor = (self.wanted / max(cost, 1e-3)) ** (1.0 / min(max(power, 1.0), 12.0))
        return min(max(self.size * min(max(factor, 0.1), 10.0), self.entry.limits[0]), self.entry.limits[1])

    @property
    def hopeless(self) -> bool:
        """Return whether the cost is too low at the largest size."""
        return bool(self.known) and self.size == self.entry.limits[1] and self.known[-1][1] < LEAST


def _hidden(study: Study, rng: np.random.Generator, count: int) -> Study:
    """Return a study with random effects of the catalogue, each of the size that has a randomly drawn cost."""
    rig = study.rig
    for _ in range(50):
        if (found := sized(study, names_of(rig, rng, count), rng, _wanted)) is not None:
            return found
    raise RuntimeError(f"seed {study.seed}: no effects that can be seen")


def sized(
    study: Study, names: Sequence[str], rng: np.random.Generator, wanted: Callable[[np.random.Generator], float]
) -> Study | None:
    """Return the study with each effect at the size of a wanted cost [nats]; None if a cost cannot be reached."""
    return _searched(study, {name: _begin(study.rig, name, rng, wanted(rng)) for name in names})


def names_of(rig: Rig, rng: np.random.Generator, count: int) -> list[str]:
    """Return names of random effects of the catalogue, at most one of each family."""
    while True:
        names = sorted(str(n) for n in rng.choice(sorted(rig.entries), count, replace=False))
        if not any(len(family & set(names)) > 1 for family in rig.families):
            return names


def _wanted(rng: np.random.Generator) -> float:
    between = SMALL if rng.random() < SMALL_SHARE else LARGE
    return math.exp(rng.uniform(*np.log(between)))


def wanted_large(rng: np.random.Generator) -> float:
    """Return a random cost [nats], as large as for a large effect."""
    return math.exp(rng.uniform(*np.log(LARGE)))


def _wanted_of_strangers(rng: np.random.Generator) -> float:
    return math.exp(rng.uniform(*np.log(OUTSIDE_COST)))


def _begin(rig: Rig, name: str, rng: np.random.Generator, wanted: float) -> _Sized:
    entry = {**rig.entries, **rig.outside}[name]
    start = float(rng.uniform(*entry.limits)) if entry.fixed else entry.start
    return _Sized(entry, entry.unit(rng), start, wanted)


def _searched(study: Study, sized: dict[str, _Sized], tries: int = 6) -> Study | None:
    """Return the study with each effect at the size of its wanted cost; None if a cost cannot be reached."""
    for _ in range(tries):
        study = replace(study, truth={name: s.entry.at(s.unit, s.size) for name, s in sized.items()})
        try:
            cost = costs(study.rig, study.base, study.truth, conditions(study))
        except ArithmeticError:
            return None
        study = replace(study, costs=cost)
        sizes = {name: s.learn(cost[name]) for name, s in sized.items()}
        if any(s.hopeless for s in sized.values()):
            return None
        if all(abs(math.log(sizes[name] / s.size)) < NEAR for name, s in sized.items()):
            break
        for name, s in sized.items():
            s.size = sizes[name]
    return study if min(study.costs.values()) >= LEAST else None


def conditions(study: Study) -> Conditions:
    """Return what `costs` needs of the estimation logs: runs without pushes, variances of readings, sizes of pushes."""
    rig, recorder = study.rig, study.recorder
    flown = [course(study, number) for number in range(2)]
    still = [replace_pushes(run) for run, _ in flown]
    variances = [
        recorder.variances(rig, result.readings, study.stamp_error, rows_to_keep(study, number))
        for number, (_, result) in enumerate(flown)
    ]
    return Conditions(still, variances, [DISTURBANCES[study.disturbance] * reach for reach in rig.pushes])


def replace_pushes(run: Run) -> Run:
    """Return the run without pushes, as the model assumes."""
    return replace(run, pushes=np.zeros_like(run.pushes))


def _strange(study: Study, rng: np.random.Generator) -> Study:
    """Return a study with an effect outside the catalogue; for the craft with the sizes of the laboratory half."""
    rig = study.rig
    if study.plant == "craft":
        name = str(rng.choice(sorted(OUTSIDE)))
        return replace(study, truth={name: {p: float(rng.uniform(*r)) for p, r in OUTSIDE[name].ranges.items()}})
    for _ in range(50):
        name = str(rng.choice(sorted(rig.outside)))
        if (found := sized(study, [name], rng, _wanted_of_strangers)) is not None:
            return found
    raise RuntimeError(f"seed {study.seed}: no stranger that can be seen")
