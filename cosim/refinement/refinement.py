"""Result of a study with everything that a report shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.estimation.problem import Problem
from cosim.estimation.subject.interface import Subject
from cosim.refinement.decision.claims import Claims
from cosim.refinement.proof.measure import ReplayedLogs
from cosim.refinement.proof.refined_models import Variant
from cosim.refinement.record import Part
from cosim.refinement.study import Study


@dataclass(frozen=True)
class Refinement:
    """Result of a study, with everything that its report shows."""

    study: Study
    verdict: Claims
    record: Mapping[str, Any]
    folder: Path
    problem: Problem
    variants: Mapping[str, Variant]
    evidence: Mapping[str, Mapping[Part, ReplayedLogs]]  # before, recalibrated, after → estimation, validation

    @property
    def refined(self) -> Subject:
        """Return the subject with the claim; unchanged without a claim."""
        return self.variants["after"].subject
