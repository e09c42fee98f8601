"""Short studies of the blind suite's own craft with something undeclared in it, and what refine makes of them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jsonschema

from cosim.estimation.problem import Problem
from cosim.estimation.subject.interface import Workplace
from cosim.logs.log import Log
from cosim.refinement.decision.bundle import bundle_of
from cosim.refinement.decision.posterior import Bundle, Decision, decide
from cosim.refinement.proof.measure import ReplayedLogs, Variant, replay_logs
from cosim.refinement.refinement import Refinement
from cosim.refinement.search.fits import Hypothesis, Search
from cosim.refinement.workflow import refine
from cosim.verbs.checks import schema_of
from tests.blind.truth import Study, write
from tests.verdicts import contradictions

FEW = "[coulomb_friction, quadratic_drag, table_tilt, servo_dead_band, gyro_bias, mass]"
SECONDS = 12.0


@dataclass(frozen=True)
class Weighed:
    """What a search comes to before replays and unnamed terms judge it; `best` is of the most probable class."""

    bundle: Bundle
    decision: Decision
    best: Hypothesis

    @property
    def claimed(self) -> set[str]:
        """Return the certain parts."""
        return set(self.decision.claimed)


def weighed(search: Search) -> Weighed:
    """Return the decision on a search."""
    bundle = bundle_of(search)
    decision = decide(bundle)
    best = search.tried[decision.nearest]
    return Weighed(bundle, decision, best)


def study_of(folder: Path, truth: dict[str, Any], kind: str = "known", seed: int = 3, **conditions: bool) -> Path:
    """Write a short study with few candidates."""
    settings = {"disturbed": False, "position": True, "duty_varied": False} | conditions
    path = write(Study(seed, kind, truth, **settings), folder, duration=SECONDS)
    path.write_text(path.read_text() + f"candidates: {FEW}\n")
    return path


def refined(folder: Path, *arguments: Any, **conditions: Any) -> Refinement:
    return proven(study_of(folder / "study", *arguments, **conditions), folder / "out")


def proven(study: Path, folder: Path) -> Refinement:
    """Refine a study; check that its results fit the schema and are consistent, for any verdict."""
    r = refine(study, folder)
    written = json.loads((folder / "refine.json").read_text())
    jsonschema.validate(written, schema_of("refine_result"))
    said = contradictions(written, folder)
    assert not said, said
    return r


def replayed(
    variant: Variant, problem: Problem, logs: Sequence[Log], folder: Path, horizons: Sequence[float] = ()
) -> dict[float, ReplayedLogs]:
    """Return replays of a variant through the delivered object."""
    with Workplace(folder, in_process=True) as place:
        return replay_logs(variant, variant.subject.replayer(place), problem, logs, horizons)


def named(r: Refinement) -> set[str]:
    return {e["name"] for e in r.record["effects"]}


def holds(r: Refinement, effect: str, parameter: str, truth: float) -> bool:
    """Return whether the interval, widened to 99.99 %, contains the truth.

    Of five tests with 95 % intervals, one in four runs would fail.
    """
    entry = next(e for e in r.record["effects"] if e["name"] == effect)["parameters"][parameter]
    low, high = entry["ci95"]
    half = 2.0 * (high - low) / 2.0
    return bool(abs(entry["value"] - truth) <= half)
