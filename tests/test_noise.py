"""Noise, references and criteria."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.blocks.faults import stream


def test_noise_is_that_measured_by_eq_5_46(project: Path) -> None:
    results = cosim.run(project / "scenarios" / "manoeuvre.yaml", in_process=True)
    for name, variance in (("psi", 2.613e-5), ("psi_dot", 4.564e-4), ("ax", 0.04479)):
        noise = results[f"controller.{name}"] - results[f"plant.{name}"]
        # relative standard error of a variance from 1301 samples is √(2/1300) = 3.9 %; four of them
        assert noise.var() == pytest.approx(variance, rel=0.16)


def test_each_source_has_a_stream_of_its_own(project: Path) -> None:
    def noise_on_psi(*overrides: str) -> np.ndarray:
        settings = ["duration=2", "criteria={}", *overrides]
        results = cosim.run(project / "scenarios" / "regulate.yaml", set=settings, in_process=True)
        return results["controller.psi"] - results["plant.psi"]

    # taking the noise off another connection moves the craft, but not the noise drawn here (1e-15: a − b of doubles)
    assert np.allclose(noise_on_psi(), noise_on_psi("connections.2.noise=null"), atol=1e-15)
    pairs = [
        stream(seed, n).standard_normal(2000)
        for seed, n in ((1, "a.psi"), (1, "a.psi_dot"), (1, "b.psi"), (2, "a.psi"))
    ]
    correlation = np.corrcoef(pairs) - np.eye(4)
    assert np.max(np.abs(correlation)) < 5 / math.sqrt(2000)  # five standard errors


CRITERIA = """name: s
start_time: 10
duration: 4
step: 1
components: {p: {block: playback, file: in.csv}}
criteria:
  peak:
  - {of: p.y, max: 2, to: p.r, after: 1}
  - {of: p.y, max: 2, after: 2, until: 3}
  - {of: p.y, max: 4, until: 1}
  final_error: {of: p.y, max: 2, to: 1, until: 3}
  effort: {of: p.y, max: 2}
  settling_time:
  - {of: p.y, max: 2, to: 1, band: 0.5, until: 3}
  - {of: p.y, max: 2, to: 1, band: 0.5}
"""


def test_criteria_are_judged_within_their_times(tmp_path: Path) -> None:
    (tmp_path / "in.csv").write_text("time,y [m],r [m]\n10,4,1\n11,-2,1\n12,1,1\n13,1,1\n14,3,1\n")
    (tmp_path / "s.yaml").write_text(CRITERIA)
    found = cosim.run(tmp_path / "s.yaml", in_process=True).criteria
    assert [c["value"] for c in found] == pytest.approx([3.0, 1.0, 4.0, 0.0, 8.0, 1.0, None])
    assert [c["met"] for c in found] == [False, True, True, True, False, True, False]
    assert [c["unit"] for c in found] == ["m", "m", "m", "m", "m.s", "s", "s"]
