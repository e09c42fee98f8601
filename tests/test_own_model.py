"""docs/own_model.md as a newcomer follows it: the page's table, logs of one that rubs, refine, and refine again."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cosim.check import check_files
from cosim.refine.model_file import read_model
from cosim.refine.question import inputs_to_limit
from cosim.refine.workflow import refine
from plant.hovercraft import Hovercraft
from tests.logs import times, write_log
from tests.table import TABLE

INERTIA, DAMPING, STIFFNESS, RUBS = 0.02, 0.01, 0.5, 0.05


def table_log(path: Path, seed: int) -> None:
    """A rotary table under a held torque, by another integrator and other code than the page's."""
    rng, time = np.random.default_rng(seed), times(20.0)
    waves = zip((0.3, 0.2, 0.15), (1.1, 3.7, 6.3), rng.uniform(0, 6, 3), strict=True)
    torque = np.sum([a * np.sin(w * time + p) for a, w, p in waves], axis=0)
    states = [np.zeros(2)]
    for u in torque[:-1]:

        def rates(_: float, x: np.ndarray, u: float = u) -> list[float]:
            moment = u - DAMPING * x[1] - STIFFNESS * x[0] - RUBS * math.tanh(x[1] / 0.05)
            return [x[1], moment / INERTIA]

        states.append(solve_ivp(rates, (0.0, 0.02), states[-1], rtol=1e-8, atol=1e-10).y[:, -1])
    angle, rate = np.array(states).T
    noise = rng.standard_normal((2, time.size))
    write_log(path, {"time": time, "torque": torque, "angle": angle + 1e-3 * noise[0], "rate": rate + 1e-2 * noise[1]})


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the page's table, three logs, a study and what came of it."""
    folder = tmp_path_factory.mktemp("own") / "bench"
    folder.mkdir()
    (folder / "table.py").write_text(TABLE, encoding="utf-8")
    for seed, name in enumerate("abc"):
        table_log(folder / f"{name}.csv", seed)
    logs = "logs:\n  estimation: [a.csv, b.csv]\n  validation: [c.csv]\n"
    (folder / "study.yaml").write_text(f"model: table.py:Table\n{logs}")
    (folder / "again.yaml").write_text(f"model: out/model.yaml\n{logs}")
    r = refine(folder / "study.yaml", folder / "out")
    assert r.record["verdict"] == "effect_found", r.record["sentence"]
    (low, high) = r.record["effects"][0]["parameters"]["level"]["ci95"]
    assert low - (high - low) < RUBS < high + (high - low)
    return folder


def test_the_table_of_the_page_refined_has_nothing_missing(bench: Path) -> None:
    assert refine(bench / "again.yaml", bench / "second").record["verdict"] == "no_effect"


def test_what_a_refine_wrote_is_a_model_that_can_be_checked(bench: Path) -> None:
    assert check_files([bench / "out" / "model.yaml"]) == []


def test_a_refined_model_moves_with_the_file_it_is_of(bench: Path, tmp_path: Path) -> None:
    moved = tmp_path / "elsewhere"
    shutil.copytree(bench, moved)
    assert read_model(moved / "out" / "model.yaml").source == f"{moved.resolve() / 'table.py'}:Table"


def test_where_the_file_is_in_another_place_its_whole_path_is_said(bench: Path, tmp_path: Path) -> None:
    refine(bench / "again.yaml", tmp_path)
    assert f"model: {bench.resolve() / 'table.py'}:Table\n" in (tmp_path / "model.yaml").read_text()


def test_of_a_model_of_ones_own_one_says_how_far_its_inputs_may_go(bench: Path) -> None:
    assert inputs_to_limit(read_model(bench / "out" / "model.yaml").model) == ("torque",)
    assert inputs_to_limit(Hovercraft()) == ()
