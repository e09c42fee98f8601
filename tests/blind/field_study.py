"""Studies of the field half and mixed ones, drawn by seed: plant, kind, effects and sizes, base parameters, recorder.

Plants alternate; kinds, numbers of effects and sizes of the disturbance come from shuffled decks. The size of an effect
is chosen so that the true model without it loses a randomly drawn log-likelihood (`field_cost`).

A mixed study has two or three effects of the catalogue; every fifth has one such effect and a stranger, an effect
outside the catalogue. The rest is as in the field half.
"""

import json
import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tests.blind.field_cost import costs
from tests.blind.field_craft import CraftRig, Pilot, craft, fly_craft, moving_start, replay_craft
from tests.blind.field_plants import Cart, DriveTrain, QuarterCar, Tanks
from tests.blind.field_recorder import Recorder
from tests.blind.field_rig import (
    BLOCK,
    LOGS,
    Array,
    Course,
    Entry,
    Random,
    Rig,
    Run,
    Truth,
    base_numbers,
    coloured,
    csv,
    dealt,
    log_uniform,
    random_stream,
    write_study,
)
from tests.blind.truth_craft import OUTSIDE, stranger

RIGS: dict[str, Rig] = {rig.name: rig for rig in (CraftRig(), DriveTrain(), Tanks(), Cart(), QuarterCar())}
PLANTS = tuple(RIGS)
MODELS = Path(__file__).with_name("plants")  # of the plants other than the craft
COUNTS = (1, 2, 3, 4)  # effects of a known study
DISTURBANCES = {"small": 0.0005, "large": 0.002}  # of the actuator's range: standard deviation
LEAST = 20.0  # nats: what an effect costs at least where it is left out
SMALL, LARGE = (25.0, 100.0), (100.0, 1600.0)  # nats, log-uniform
SMALL_SHARE = 0.38  # of the effects that are sized; the others, latencies, are always large
NEAR = 0.15  # share of a size to which the search goes
OUTSIDE_COST = (200.0, 1600.0)  # nats
SKIPPED = 2.0  # [s] of rows of 50 ms and faster that are not judged at the start of a log; longer where rows are slower
SEALED = LOGS.index("v1")

Wanted = Callable[[Random], float]  # → a random cost [nats]


@dataclass(frozen=True)
class Study:
    """Answer of a study: hidden effects and recorder; `costs` [nats] of the effects."""

    half: str
    seed: int
    plant: str
    kind: str
    truth: Truth
    base: dict[str, float]
    disturbance: str
    recorder: Recorder
    stamp_error: float = 0.0
    costs: dict[str, float] = field(default_factory=dict)

    @property
    def rig(self) -> Rig:
        """Return the plant."""
        return RIGS[self.plant]

    @property
    def push_deviations(self) -> list[float]:
        """Return the standard deviations of the disturbance."""
        return [DISTURBANCES[self.disturbance] * reach for reach in self.rig.pushes]


SUITE = 60493  # of this half and of the FMUs
stream, card = partial(random_stream, SUITE), partial(dealt, SUITE)


def deal(seed: int) -> dict[str, Any]:
    """Return what decks decide of a seed, which is all but effects and sizes."""
    kind, _ = card(BLOCK, seed, 1)
    return {"plant": PLANTS[seed % len(PLANTS)], "kind": kind, "disturbance": card(tuple(DISTURBANCES), seed, 3)[0]}


def draw(seed: int) -> Study:
    """Return the study of a seed, reproducible byte for byte."""
    rng, (kind, number) = stream(seed, 4), card(BLOCK, seed, 1)
    study = bare("field", seed, rng, kind)
    if kind == "known":
        count, _ = card(COUNTS, number, 2)
        return hidden(lambda: sized(study, names_of(study.rig, rng, count), rng, _wanted))
    if kind == "nothing":
        return study
    if study.plant == "craft":  # with the sizes of the laboratory half
        name = str(rng.choice(sorted(OUTSIDE)))
        return replace(study, truth={name: stranger(name, rng)})
    return hidden(lambda: sized(study, [str(rng.choice(sorted(study.rig.outside)))], rng, costing(OUTSIDE_COST)))


def draw_mixed(seed: int) -> Study:
    """Return the mixed study of a seed, with several hidden effects."""
    rng = stream(seed, 6)
    study = bare("mixed", seed, rng)
    strange = (seed // len(PLANTS)) % 5 == 4 and study.plant != "craft"  # a craft has one effect or one stranger

    def names() -> list[str]:
        if strange:
            return [str(rng.choice(sorted(study.rig.entries))), str(rng.choice(sorted(study.rig.outside)))]
        return names_of(study.rig, rng, int(rng.integers(2, 4)))

    return hidden(lambda: sized(study, names(), rng, costing(LARGE)))


def bare(half: str, seed: int, rng: Random, kind: str = "known") -> Study:
    """Return a study with base parameters, disturbance and recorder, but without hidden effects.

    Args:
        kind: `known`, `nothing` or `outside`, the label of what is hidden later.
    """
    plant = PLANTS[seed % len(PLANTS)]
    rig = RIGS[plant]
    longest_hole = min(90, int(0.45 / rig.step)) if rig.step < 0.05 else 9
    recorder = Recorder.draw(rng, list(rig.outputs), longest_hole)
    disturbance, _ = card(tuple(DISTURBANCES), seed, 3)
    study = Study(half, seed, plant, kind, {}, base_numbers(rig.sheet, rng), disturbance, recorder)
    if recorder.timing:
        study = replace(study, stamp_error=recorder.stamp_error(rig, course(study, 0)[1].readings))
    return study


def names_of(rig: Rig, rng: Random, count: int) -> list[str]:
    """Return names of random effects of the catalogue, at most one of each family."""
    while True:
        names = sorted(str(n) for n in rng.choice(sorted(rig.entries), count, replace=False))
        if not any(len(family & set(names)) > 1 for family in rig.families):
            return names


def costing(between: tuple[float, float]) -> Wanted:
    """Return what draws a cost [nats], log-uniform."""
    return lambda rng: log_uniform(rng, between)


def _wanted(rng: Random) -> float:
    return log_uniform(rng, SMALL if rng.random() < SMALL_SHARE else LARGE)


# -- how it moves ------------------------------------------------------------------------------------------


def course(study: Study, number: int) -> tuple[Run, Course]:
    """Return log `number`: its inputs, and the readings of correct sensors without noise."""
    rig = study.rig
    manoeuvre, pushed, clock = (stream(study.seed, 10 + number, purpose) for purpose in range(3))
    pushes = coloured(pushed, rig.rows, study.push_deviations, rig.step, rig.correlation_time)
    times = study.recorder.times(clock, rig.rows, rig.step)
    if isinstance(rig, CraftRig):
        made, start = craft(study.base, study.truth), moving_start(manoeuvre)
        pilot = Pilot(manoeuvre, bool(manoeuvre.random() < 0.5), times.size, start.get("psi", 0.0))
        inputs = times, pushes, noise(study, number)
        return fly_craft(made, start, pilot, study.truth, inputs)
    run = Run(times, rig.drive(manoeuvre), pushes, rig.begin(manoeuvre))
    return run, rig.course(rig.numbers(study.base, study.truth), run)


def noise(study: Study, number: int) -> Array:
    """Return the noise of the sensors, shape (rows, outputs)."""
    white = stream(study.seed, 10 + number, 3).standard_normal((study.rig.rows, len(study.rig.outputs)))
    return white * study.recorder.deviations(study.rig)


def rows_to_keep(study: Study, number: int) -> Array:
    """Return which cells of a log are recorded, shape (rows, outputs)."""
    return study.recorder.rows_to_keep(stream(study.seed, 10 + number, 4), study.rig.rows, len(study.rig.outputs))


# -- how large it is ---------------------------------------------------------------------------------------


def hidden(attempt: Callable[[], Study | None]) -> Study:
    """Return the first study of several attempts in which all effects have the sizes of their wanted costs."""
    for _ in range(50):
        if (found := attempt()) is not None:
            return found
    raise RuntimeError("no effects that can be seen")


def next_size(entry: Entry, wanted: float, size: float, cost: float, last: tuple[float, float] | None) -> float:
    """Return the next size to try, within the limits, from a power law of the cost, at first the square.

    Args:
        entry: of the effect.
        wanted: its cost [nats].
        size: just tried.
        cost: of this size.
        last: size tried before, with its cost.
    """
    power = 2.0
    if last and abs(math.log(size / last[0])) > 1e-3:
        power = math.log(cost / last[1]) / math.log(size / last[0])
    factor = (wanted / cost) ** (1.0 / min(max(power, 1.0), 12.0))
    return float(min(max(size * min(max(factor, 0.1), 10.0), entry.low), entry.high))


def sized(study: Study, names: Sequence[str], rng: Random, wanted: Wanted) -> Study | None:
    """Return the study with each effect at the size of its wanted cost; None if a cost cannot be reached."""
    entries, goals, sizes, units = {name: study.rig.every_entry[name] for name in names}, {}, {}, {}
    for name, entry in entries.items():
        goals[name] = wanted(rng)
        sizes[name] = float(rng.uniform(entry.low, entry.high)) if entry.fixed else entry.start
        units[name] = entry.unit(rng)
    searched, last = [name for name, entry in entries.items() if not entry.fixed], {}
    for _ in range(6):
        study = replace(study, truth={name: entry.at(units[name], sizes[name]) for name, entry in entries.items()})
        try:
            study = with_costs(study)
        except ArithmeticError:
            return None
        before = dict(sizes)
        for name in searched:
            entry, cost = entries[name], max(study.costs[name], 1e-3)
            if before[name] == entry.high and cost < LEAST:
                return None  # the cost is too low at the largest size
            sizes[name] = next_size(entry, goals[name], before[name], cost, last.get(name))
            last[name] = before[name], cost
        if all(abs(math.log(sizes[name] / before[name])) < NEAR for name in searched):
            break
    return study if min(study.costs.values()) >= LEAST else None


def with_costs(study: Study) -> Study:
    """Return the study with the costs of its effects, from the estimation logs."""
    rig, recorder = study.rig, study.recorder
    flown = [course(study, number) for number in range(2)]
    variances = [
        recorder.variances(rig, result.readings, study.stamp_error, rows_to_keep(study, number))
        for number, (_, result) in enumerate(flown)
    ]
    runs = [undisturbed(run) for run, _ in flown]
    return replace(study, costs=costs(rig, study.base, study.truth, runs, variances, study.push_deviations))


def undisturbed(run: Run) -> Run:
    """Return the run without pushes, as the model assumes."""
    return replace(run, pushes=np.zeros_like(run.pushes))


# -- files and answer --------------------------------------------------------------------------------------


def recorded(study: Study, number: int) -> tuple[Run, Course, Array]:
    """Return log `number`: its inputs, its course, and the recorded cells, NaN if missing."""
    run, result = course(study, number)
    spoiling = stream(study.seed, 10 + number, 5)
    cells = study.recorder.spoil(spoiling, study.rig, result.readings, noise(study, number), study.stamp_error)
    return run, result, np.where(rows_to_keep(study, number), cells, np.nan)


def write(study: Study, folder: Path) -> Path:
    """Write study.yaml, the model file and the logs, without the answer; return the path of study.yaml."""
    if study.plant == "craft":  # the tolerances of the others are in their model files
        return write_study(
            folder, "base", logs_of(study), {name: share for name, (_, share) in study.rig.sheet.items()}
        )
    path = write_study(folder, f"{study.plant}.py:{study.rig.model}", logs_of(study))
    shutil.copyfile(MODELS / f"{study.plant}.py", folder / f"{study.plant}.py")
    return path


def logs_of(study: Study) -> list[str]:
    """Return the logs as CSV without rows that are lost as a whole."""
    texts = []
    for number in range(len(LOGS)):
        run, _, cells = recorded(study, number)
        kept = ~np.isnan(cells).all(axis=1) | (not study.recorder.whole_rows)
        columns = (".6f", run.times[kept, None]), (".6g", run.commands[kept]), (".7g", cells[kept])
        texts.append(csv(["time", *study.rig.inputs, *study.rig.outputs], *columns))
    return texts


def true_error(study: Study) -> dict[str, float]:
    """Return the root mean square of recorded − true model on the sealed log, by channel.

    The true model starts at the true state once per horizon, with the true sensor errors and without disturbance. Cells
    are those of the log, outliers included.
    """
    rig = study.rig
    run, result, cells = recorded(study, SEALED)
    if isinstance(rig, CraftRig):
        predicted = replay_craft(craft(study.base, study.truth), study.truth, run, result)
    else:
        resets = {k: result.states[k] for k in range(0, run.times.size, round(rig.horizon / rig.step))}
        predicted = rig.course(rig.numbers(study.base, study.truth), undisturbed(run), resets).readings
    skipped = SKIPPED * max(1.0, math.ceil(rig.step / 0.05))
    judged = (run.times >= run.times[0] + skipped)[:, None]
    off = np.where(judged, cells - predicted, np.nan)
    return {o: float(np.sqrt(np.nanmean(column**2))) for o, column in zip(rig.outputs, off.T, strict=True)}


def answer(study: Study, **more: Any) -> str:
    """Return the answer as JSON, to be opened after the verdict."""
    late = ("late",) if study.rig.late()[0] in study.truth else ()  # a fault, and an effect
    faults, sensors = [*study.recorder.faults, *late], list(study.rig.sensors)
    told = asdict(study) | {"faults": faults, "sensors": sensors, "error_true": true_error(study)}
    if study.half == "mixed":
        told["strangers"] = sorted(set(study.truth) & set(study.rig.outside))
    return json.dumps(told | more, indent=1) + "\n"
