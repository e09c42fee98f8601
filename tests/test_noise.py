"""Noise, references, playback, designs and criteria."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from cosim.blocks.faults import gaussian, stream
from cosim.blocks.profile import Change, Profile, ProfileFunction
from cosim.blocks.sources import playback
from cosim.core.errors import InputError
from cosim.master.master import simulate
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.system import build_system


def test_noise_has_the_variance_and_bias_it_is_given() -> None:
    samples = np.array(gaussian(stream(1, "controller.ax"), 0.04479, 0.1, 100_000))
    # standard errors at 1e5 samples: σ/√n = 7e-4 for the mean, σ²·√(2/n) = 2e-4 for the variance; five of each
    assert samples.mean() == pytest.approx(0.1, abs=3.5e-3)
    assert samples.var() == pytest.approx(0.04479, abs=1e-3)


def test_row_k_carries_sample_k_of_its_stream(project: Path) -> None:
    file = ScenarioFile(project / "scenarios" / "regulate.yaml")
    results = simulate(build_system(file), 20, 0.02)
    samples = gaussian(stream(1, "controller.ax"), 0.04479, 0.0, 21)
    # a sum of two doubles, and their difference again: 1e-15 of numbers below 4
    assert np.allclose(results["controller.ax"] - results["plant.ax"], samples, atol=1e-14)


def test_noise_is_the_measured_noise_of_eq_5_46_in_a_run(project: Path) -> None:
    file = ScenarioFile(project / "scenarios" / "manoeuvre.yaml")
    results = simulate(build_system(file), file.scenario.steps, 0.02)
    for name, variance in (("psi", 2.613e-5), ("psi_dot", 4.564e-4), ("ax", 0.04479)):
        noise = results[f"controller.{name}"] - results[f"plant.{name}"]
        # relative standard error of a variance from 1301 samples is √(2/1300) = 3.9 %; four of them
        assert noise.var() == pytest.approx(variance, rel=0.16)


def test_each_source_has_a_stream_of_its_own(project: Path) -> None:
    path = project / "scenarios" / "regulate.yaml"

    def noise_on_psi(*overrides: str) -> np.ndarray:
        file = ScenarioFile(path, overrides)
        results = simulate(build_system(file), 100, 0.02)
        return results["controller.psi"] - results["plant.psi"]

    # taking the noise off another connection moves the craft, but not the noise drawn here (1e-15: a − b of doubles)
    assert np.allclose(noise_on_psi(), noise_on_psi("connections.2.noise=null"), atol=1e-15)
    pairs = [stream(1, n).standard_normal(2000) for n in ("a.psi", "a.psi_dot", "b.psi")] + [
        stream(2, "a.psi").standard_normal(2000)
    ]
    correlation = np.corrcoef(pairs) - np.eye(4)
    assert np.max(np.abs(correlation)) < 5 / math.sqrt(2000)  # five standard errors


@pytest.mark.parametrize(
    ("changes", "values"),
    [
        (
            [Change(at=1.0, to=2.0), Change(at=3.0, to=-2.0, rate=2.0)],
            {0.0: 1.0, 0.99: 1.0, 1.0: 2.0, 2.99: 2.0, 3.0: 2.0, 3.5: 1.0, 5.0: -2.0, 9.0: -2.0},
        ),
        (  # a change interrupts the ramp before it
            [Change(at=0.0, to=11.0, rate=1.0), Change(at=2.0, to=1.0, rate=4.0)],
            {1.0: 2.0, 2.0: 3.0, 2.25: 2.0, 3.0: 1.0},
        ),
        # a step at a multiple of the step is not a sample late: 3·0.1 is 0.30000000000000004
        ([Change(at=0.3, to=2.0)], {3 * 0.1: 2.0, 0.1 + 0.1 + 0.1 - 5.6e-17: 2.0, 0.28: 1.0}),
    ],
)
def test_a_reference_from_1_follows_its_changes(changes: list[Change], values: dict[float, float]) -> None:
    f = ProfileFunction(Profile(start=1.0, changes=changes))
    assert [f(t) for t in values] == pytest.approx(list(values.values()), rel=1e-15)


def test_a_faulty_playback_file_is_told_cell_by_cell(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("time,u\n0,1\n0.1,x\n0.05,2\n0.2\n0.3,nan\n")
    with pytest.raises(InputError) as caught:
        playback("log", log)
    told = [str(f).removeprefix(f"{log}:") for f in caught.value.faults]
    assert [t.split(" ")[0] for t in told] == ["3:2:", "4:1:", "5:1:", "6:2:"]
