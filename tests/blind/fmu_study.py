"""Studies of the FMUs' suite, drawn by seed: plant, way, version of FMI, kind, effects, sizes, base parameters.

    python -m tests.blind.fmu_study 3 /tmp/study      seed and folder; prints the answer

Six plants alternate; over 24 consecutive seeds each is drawn with both ways and both versions. Of 20 consecutive seeds
12 hide one or two effects of the catalogue, 5 nothing, 3 an effect outside of it. An effect of usual size costs 500 to
5000 nats (`field_cost`); half of the known studies have a fifth of that size instead, which costs 20 nats at least.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from tests.blind import field_write
from tests.blind.field_recorder import Recorder
from tests.blind.field_rig import Entry, Random, Rig, base_numbers, show, write_study
from tests.blind.field_study import LEAST, OUTSIDE_COST, Study, card, costing, names_of, sized, stream, with_costs
from tests.blind.fmu_build import PLANTS as DECLARED
from tests.blind.fmu_build import WAYS, build, build_slave
from tests.blind.fmu_rig import CoSimulation, FmuRig, ModelExchange, place
from tests.blind.fmu_truths import CLASSES, RIGS

PLANTS = tuple(rig.name for rig in CLASSES)
DEALT = {"known", "nothing", "outside", "usual", "fifth", *PLANTS, *WAYS}  # what is decided without effects
BLOCK = ("known",) * 12 + ("nothing",) * 5 + ("outside",) * 3  # of twenty consecutive seeds, in shuffled order
HIDDEN = (("usual", 1), ("fifth", 1), ("usual", 2), ("fifth", 1), ("usual", 1), ("fifth", 2))  # size, effects
USUAL = (500.0, 5000.0)  # nats, log-uniform
SMALLER = 5.0
OWN_C, PYTHONFMU = "own C", "pythonfmu"
FIRST_OF_TWO = 5000  # first seed with a second exporter; earlier studies stay as they were
SLAVES = {("tanks", "co_simulation", 2)}  # plant, way and version of FMI that pythonfmu makes too
OWN = 26  # first number of this suite's random streams


@dataclass(frozen=True)
class Deal:
    """Properties of a seed from the shuffled decks."""

    seed: int
    plant: str
    way: str
    version: int
    kind: str  # known, nothing, outside
    size: str  # usual, fifth; empty without effects of the catalogue
    effects: int


@dataclass(frozen=True)
class FmuStudy(Study):
    """Answer of a study, with way and version of the FMU, and the size of the effects."""

    way: str = ModelExchange
    version: int = 2
    size: str = ""

    @property
    def exporter(self) -> str:
        """Return the exporter of the FMU: own C, or that of every second study which another exporter can make."""
        made = (self.plant, self.way, self.version) in SLAVES and self.seed >= FIRST_OF_TWO
        return PYTHONFMU if made and stream(self.seed, OWN + 2).uniform() < 0.5 else OWN_C

    @property
    def rig(self) -> Rig:
        """Return the plant."""
        return RIGS[self.plant, self.way]


def deal(seed: int) -> Deal:
    """Return the properties of a seed from the decks."""
    kind, number = card(BLOCK, seed, OWN, 1)
    size, count = card(HIDDEN, number, OWN + 1)[0] if kind == "known" else ("", int(kind == "outside"))
    round_, half = seed // len(PLANTS), seed // (2 * len(PLANTS))
    plant, way, version = PLANTS[seed % len(PLANTS)], WAYS[(seed + round_) % 2], 2 + (seed + half) % 2
    return Deal(seed, plant, way, version, kind, size, count)


@cache
def draw(seed: int) -> FmuStudy:
    """Return the study of a seed, reproducible byte for byte."""
    dealt, rng = deal(seed), stream(seed, OWN, 2)
    rig = RIGS[dealt.plant, dealt.way]
    study = FmuStudy(
        seed, dealt.plant, dealt.kind, {}, base_numbers(rig.sheet, rng), "small",
        Recorder(noise=dict.fromkeys(rig.outputs, 1.0)), way=dealt.way, version=dealt.version, size=dealt.size,
    )  # fmt: skip
    if dealt.kind == "nothing":
        return study
    for _ in range(50):
        if dealt.kind == "known":
            found = _known(study, names_of(rig, rng, dealt.effects), rng)
        else:
            found = sized(study, [str(rng.choice(sorted(rig.outside)))], rng, costing(OUTSIDE_COST))
        if isinstance(found, FmuStudy):
            return found
    raise RuntimeError(f"seed {seed}: no effects that can be seen")


def _known(study: FmuStudy, names: Sequence[str], rng: Random) -> Study | None:
    """Return the study with effects of usual size or a fifth; None if one cannot have it."""
    found = sized(study, names, rng, costing(USUAL))
    if found is None or study.size == "usual":
        return found
    entries = found.rig.entries
    found = replace(found, truth={name: shrunk(entries[name], values) for name, values in found.truth.items()})
    assert isinstance(found.rig, FmuRig)
    if not found.rig.resolves(found.truth):
        return None
    found = with_costs(found)
    return found if min(found.costs.values()) >= LEAST else None


def shrunk(entry: Entry, values: dict[str, float]) -> dict[str, float]:
    """Return the parameters of an effect at a fifth of its size."""
    if entry.inverse:
        return {p: v if p in entry.shape else v * SMALLER for p, v in values.items()}
    return {p: v if p in entry.shape else entry.neutral + (v - entry.neutral) / SMALLER for p, v in values.items()}


def is_any_of(seed: int, chosen: AbstractSet[str]) -> bool:
    """Return whether the kind, plant, way, size or an effect of a seed is in `chosen`."""
    dealt = deal(seed)
    if {dealt.kind, dealt.plant, dealt.way, dealt.size} & chosen:
        return True
    rig = RIGS[dealt.plant, dealt.way]
    possible = {"known": rig.entries, "outside": rig.outside}.get(dealt.kind, {})
    return bool(chosen & possible.keys()) and bool(draw(seed).truth.keys() & chosen)


def known_names() -> set[str]:
    """Return kinds, plants, ways, sizes and effects."""
    return {*DEALT, *(name for rig in RIGS.values() for name in (*rig.entries, *rig.outside))}


# -- files and answer --------------------------------------------------------------------------------------


def write(study: FmuStudy, folder: Path) -> Path:
    """Write study.yaml, the FMU and the logs, without the answer; return the path of study.yaml."""
    names = {place(v.name): v.name for v in DECLARED[study.plant].parameters}
    tolerance = ", ".join(f"{names[name]}: {share:g}" for name, (_, share) in study.rig.sheet.items())
    path = write_study(folder, "plant.fmu", field_write.logs_of(study), f"tolerance: {{{tolerance}}}\n")
    shutil.copyfile(_fmu(study.plant, study.version, study.way, study.exporter), folder / "plant.fmu")
    return path


@cache
def _fmu(plant: str, version: int, way: str, exporter: str = OWN_C) -> Path:
    path = Path(tempfile.mkdtemp(prefix="blind-fmu-")) / "plant.fmu"
    return build_slave(path, plant) if exporter == PYTHONFMU else build(path, plant, version, ways=(way,))


def claimed(study: FmuStudy) -> dict[str, dict[str, float]]:
    """Return the truth in the units of a claim.

    A force without a port is claimed as a rate: it is divided by the true inertia. Where a damping of the FMU tells how
    forces act, the claim is a force. In co-simulation an effect at a storage has the name of the output that shows it.
    """
    rig, told = study.rig, {}
    assert isinstance(rig, FmuRig)
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
    return field_write.answer(study, half="fmu", truth=claimed(study), physical=study.truth)


if __name__ == "__main__":
    show("fmu_study", draw, write, answer)
