"""What a refine claims beside what no catalogue has, and which candidates are special cases of others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cosim.estimation.subject.model_subject import ModelSubject
from cosim.refinement.decision.bundle import families
from cosim.refinement.workflow import refine
from plant.hovercraft import Hovercraft
from tests.blind import arm


def test_a_friction_that_decreases_with_speed_contains_dry_friction() -> None:
    found = families(ModelSubject.of(Hovercraft()).candidates(()))
    assert found["stribeck_friction"] == "coulomb_friction"
    assert "coulomb_friction" not in found


@pytest.mark.thorough
@pytest.mark.xfail(strict=True, reason="ambiguous: a cable spring beside the friction, 72 %")
def test_friction_of_an_arm_is_claimed_beside_what_no_catalogue_has(tmp_path: Path) -> None:
    """Fine encoders on an unstable plant, an elastic belt and torque ripple; the yardstick is a least-squares fit."""
    study = arm.draw(3)
    told: Any = refine(arm.write(study, tmp_path / "study"), tmp_path / "out").record
    assert (told["verdict"], told["grade"]) == ("effect_found", "part")
    found = {e["name"]: e["parameters"]["level"]["value"] for e in told["effects"]}
    assert found.keys() == study.truth.keys()
    for name, values in study.truth.items():
        assert found[name] == pytest.approx(values["level"], rel=0.1)
    errors, floor = told["error"], told["noise_floor"]
    for channel, before in errors["before"]["validation"].items():
        assert errors["after"]["validation"][channel] < 0.15 * before
        assert floor[channel] < before
