"""Fix sensors: sampled, delayed and lost measurements."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cosim
from cosim.authoring.export import export_ssp
from cosim.core.errors import InputError
from cosim.simulation.run_signals import Run

LEVEL = """name: level
duration: {duration}
step: 0.1
seed: 3
algorithm: {algorithm}
components:
  filling:
    block: reference
    signals: {{level: {{unit: m, changes: [{{at: 0, to: {duration}, rate: 1}}]}}}}
  sonar:
    block: fix
    rate: 2
    latency: {latency}
    dropout: {dropout}
    signals: {signals}
connections:
  - {{from: filling.level, to: sonar.level}}
"""
ALONE = "{level: {unit: m}}"
NOISY = "{level: {unit: m, noise: {variance: 4e-4, bias: 0.1}}}"


def run(folder: Path, signals: str = ALONE, *overrides: str, **more: Any) -> Run:
    keys = {"latency": 0.0, "dropout": 0.0, "algorithm": "gauss-seidel", "duration": 10, "signals": signals} | more
    path = folder / "level.yaml"
    path.write_text(LEVEL.format(**keys), encoding="utf-8")
    return cosim.run(path, set=[*overrides], in_process=True)


@pytest.mark.parametrize(("latency", "late"), [(0.0, 0), (0.3, 3), (0.25, 3), (0.7, 7)])
def test_a_fix_is_held_until_the_next_and_known_after_its_latency(tmp_path: Path, latency: float, late: int) -> None:
    results = run(tmp_path, latency=latency)
    k = np.arange(101)
    latest = (k - late) // 5  # a fix every fifth communication point, 2 Hz at 0.1 s
    assert results["sonar.fix"].tolist() == np.maximum(0, latest + 1).tolist()
    # the level rises by 1 m/s: what was measured is the time of the fix
    assert results["sonar.level_meas"] == pytest.approx(np.maximum(0, latest) * 0.5, abs=1e-12)


def test_fixes_have_the_noise_they_are_given_and_none_where_noise_is_off(tmp_path: Path) -> None:
    results = run(tmp_path, NOISY, duration=1000)
    error = results["sonar.level_meas"][::5] - results["filling.level"][::5]
    # standard errors at 2000 fixes: σ/√n = 4.5e-4 of the mean, σ²·√(2/n) = 1.3e-5 of the variance; four of each
    assert error.mean() == pytest.approx(0.1, abs=1.8e-3)
    assert error.var() == pytest.approx(4e-4, abs=5e-5)
    silent = run(tmp_path, NOISY, "noise=off")
    assert silent["sonar.level_meas"][::5] == pytest.approx(silent["filling.level"][::5], abs=1e-12)


def test_lost_fixes_are_not_counted_and_what_came_last_is_held(tmp_path: Path) -> None:
    results = run(tmp_path, dropout=0.3, duration=1000)
    counted = results["sonar.fix"]
    assert counted[-1] == pytest.approx(2001 * 0.7, abs=4 * (2001 * 0.3 * 0.7) ** 0.5)  # four standard deviations
    same = np.diff(counted) == 0
    assert (np.diff(results["sonar.level_meas"])[same] == 0).all()
    assert set(np.diff(counted)) == {0.0, 1.0}


def test_every_fault_of_a_sensor_is_told_with_its_line_and_an_ssp_holds_no_fixes(tmp_path: Path) -> None:
    with pytest.raises(InputError) as told:
        run(tmp_path, "{level: {unit: m}, fix: {}, level_meas: {unit: m}}", "components.sonar.rate=20")
    said = str(told.value)
    for words in (
        "level.yaml:15",
        "rate is 20 Hz; use at most 10 Hz",
        '"fix" is already the name of',
        '"level_meas" is already the name of',
    ):
        assert words in said
    with pytest.raises(InputError, match="less than or equal to 1"):
        run(tmp_path, dropout=1.5)
    with pytest.raises(InputError, match="unit mismatch"):
        run(tmp_path, "{level: {unit: K}}")
    run(tmp_path)
    with pytest.raises(InputError, match="fixes cannot be exported"):
        export_ssp(tmp_path / "level.yaml", tmp_path / "level.ssp")
