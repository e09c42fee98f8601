"""Studies of the FMUs' suite, drawn by seed: plant, way, version of FMI, kind, effects, sizes, base parameters.

Six plants alternate; over 24 consecutive seeds each is drawn with both ways and both versions. Of 20 consecutive seeds
12 hide one or two effects of the catalogue, 5 nothing, 3 an effect outside of it. An effect of usual size costs 500 to
5000 nats (`field_cost`); half of the known studies have a fifth of that size instead, which costs 20 nats at least.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tests.blind import field_study
from tests.blind.field_recorder import Recorder
from tests.blind.field_rig import Entry, Rig, base_numbers, write_study
from tests.blind.field_study import Study, card, costing, hidden, sized, stream
from tests.blind.fmu_build import PLANTS as DECLARED
from tests.blind.fmu_build import WAYS, build, build_slave
from tests.blind.fmu_rig import CoSimulation, ModelExchange, place
from tests.blind.fmu_truths import CLASSES, RIGS

PLANTS = tuple(rig.name for rig in CLASSES)
BLOCK = ("known",) * 12 + ("nothing",) * 5 + ("outside",) * 3  # of twenty consecutive seeds, in shuffled order
HIDDEN = (("usual", 1), ("fifth", 1), ("usual", 2), ("fifth", 1), ("usual", 1), ("fifth", 2))  # size, effects
USUAL = (500.0, 5000.0)  # nats, log-uniform
SMALLER = 5.0
SLAVES = {("tanks", "co_simulation", 2)}  # plant, way and version of FMI that pythonfmu makes too
FIRST_OF_TWO = 5000  # first seed with a second exporter; earlier studies stay as they were
OWN = 26  # first number of this suite's random streams


@dataclass(frozen=True)
class FmuStudy(Study):
    """Answer of a study, with way and version of the FMU, and the size of the effects."""

    way: str = ModelExchange
    version: int = 2
    size: str = ""

    @property
    def rig(self) -> Rig:
        """Return the plant."""
        return RIGS[self.plant, self.way]


def deal(seed: int) -> dict[str, Any]:
    """Return the properties of a seed from the decks; the size is `usual`, `fifth` or, without known effects, empty."""
    kind, number = card(BLOCK, seed, OWN, 1)
    size, count = card(HIDDEN, number, OWN + 1)[0] if kind == "known" else ("", 0)
    round_, half = seed // len(PLANTS), seed // (2 * len(PLANTS))
    plant, way, version = PLANTS[seed % len(PLANTS)], WAYS[(seed + round_) % 2], 2 + (seed + half) % 2
    dealt = {"plant": plant, "kind": kind, "effects": count, "disturbance": "small"}
    return dealt | {"way": way, "version": version, "size": size}


def draw(seed: int) -> Study:
    """Return the study of a seed, reproducible byte for byte."""
    dealt, rng = deal(seed), stream(seed, OWN, 2)
    count, rig = dealt.pop("effects"), RIGS[dealt["plant"], dealt["way"]]
    recorder = Recorder(noise=dict.fromkeys(rig.outputs, 1.0))
    study = FmuStudy("fmu", seed, truth={}, base=base_numbers(rig.sheet, rng), recorder=recorder, **dealt)

    def known() -> Study | None:
        """Return the study with effects of usual size or a fifth; None if one cannot have it."""
        found = sized(study, field_study.names_of(rig, rng, count), rng, costing(USUAL))
        if found is None or study.size == "usual":
            return found
        found = replace(found, truth={name: shrunk(rig.entries[name], v) for name, v in found.truth.items()})
        found = field_study.with_costs(found) if rig.resolves(found.truth) else None
        return found if found and min(found.costs.values()) >= field_study.LEAST else None

    if study.kind == "nothing":
        return study
    if study.kind == "known":
        return hidden(known)
    return hidden(lambda: sized(study, [str(rng.choice(sorted(rig.outside)))], rng, costing(field_study.OUTSIDE_COST)))


def shrunk(entry: Entry, values: dict[str, float]) -> dict[str, float]:
    """Return the parameters of an effect at a fifth of its size."""
    if entry.inverse:
        return {p: v if p in entry.shape else v * SMALLER for p, v in values.items()}
    return {p: v if p in entry.shape else entry.neutral + (v - entry.neutral) / SMALLER for p, v in values.items()}


# -- files and answer --------------------------------------------------------------------------------------


def write(study: FmuStudy, folder: Path) -> Path:
    """Write study.yaml, the FMU and the logs, without the answer; return the path of study.yaml.

    Every second study that pythonfmu can make, too, has its FMU from there.
    """
    names = {place(v.name): v.name for v in DECLARED[study.plant].parameters}
    tolerance = {names[name]: share for name, (_, share) in study.rig.sheet.items()}
    path = write_study(folder, "plant.fmu", field_study.logs_of(study), tolerance)
    of_two = (study.plant, study.way, study.version) in SLAVES and study.seed >= FIRST_OF_TWO
    if of_two and stream(study.seed, OWN + 2).uniform() < 0.5:
        build_slave(folder / "plant.fmu", study.plant)
    else:
        build(folder / "plant.fmu", study.plant, study.version, ways=(study.way,))
    return path


def claimed(study: FmuStudy) -> dict[str, dict[str, float]]:
    """Return the truth in the units of a claim.

    A force without a port is claimed as a rate: it is divided by the true inertia. Where a damping of the FMU tells how
    forces act, the claim is a force. In co-simulation an effect at a storage has the name of the output that shows it.
    """
    rig, told = RIGS[study.plant, study.way], {}
    states = [place(v.name) for v in DECLARED[study.plant].states]
    shown = {states[y.state]: place(name) for name, y in rig.plants_outputs.items() if study.way == CoSimulation}
    for name, values in study.truth.items():
        kind, _, at = name.partition("_at_")
        pair = rig.pairs.get(at)
        inertia = study.base[pair.inertia] if pair and pair.inertia else 1.0
        told[f"{kind}_at_{shown[at]}" if at in rig.storages and at in shown else name] = {
            p: v if p in ("speed", "period") else v / inertia for p, v in values.items()
        }
    return told


def answer(study: FmuStudy) -> str:
    """Return the answer as JSON, to be opened after the verdict."""
    return field_study.answer(study, truth=claimed(study), physical=study.truth)
