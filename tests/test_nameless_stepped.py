"""Terms without a name in co-simulation: what drives the deviations of a free run depends on its outputs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import cosim
from tests.blind import coupled

BESIDE = "ambiguous: a square law at the torque beside it, 58 %"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("case", "verdict", "signals"),
    [
        ("gap", "unexplained", ["phi1 − phi2"]),
        ("dry_hinge", "unexplained", ["rate of phi1"]),
        pytest.param("stiffness", "parameter_error", [], marks=pytest.mark.xfail(strict=True, reason=BESIDE)),
        ("nothing", "no_effect", []),
    ],
)
def test_an_effect_inside_is_no_wrong_parameter(tmp_path: Path, case: str, verdict: str, signals: list[str]) -> None:
    coupled.write(tmp_path, case, 2, "co_simulation")
    found = cosim.refine(tmp_path / "study.yaml", out=tmp_path / "refined", report=False)
    answer = json.loads((tmp_path / "refined" / "refine.json").read_text(encoding="utf-8"))
    assert found.verdict == answer["verdict"] == verdict
    assert answer["residual"]["signals"] == signals
    if signals:
        assert "Something that was not tried" in answer["sentence"]
