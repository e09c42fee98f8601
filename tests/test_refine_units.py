"""What a refine says does not depend on the unit of a state: one mass, its place in metres and in millimetres."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cosim.refinement.refinement import Refinement
from cosim.refinement.workflow import refine
from tests.logs import times, write_log

pytestmark = pytest.mark.optimized

MASS, DRAG, PULL = 2.0, 0.5, 0.06  # [kg], [N s/m], [N s²/m²]; the model does not know of the last
NOISE = 1e-4  # [m] of the place
MODEL = """
from dataclasses import dataclass
from cosim.model import Equations, Model, Quantity, parameter

@dataclass(frozen=True, kw_only=True)
class Mass(Model):
    base_states = (Quantity("place", "1", "place"), Quantity("speed", "1", "speed"))
    inputs, outputs = (Quantity("force", "N", "force"),), base_states[:1]
    sensor_variance = {{"place": ({noise} * {scale}) ** 2}}
    forced, calibrated = ("speed",), ("mass",)
    mass: float = parameter({mass}, unit="kg", bounds=(0.1, 10), doc="mass")
    drag: float = parameter({drag}, unit="N.s/m", bounds=(0, 10), doc="viscous friction")
    def equations(self, m):
        def derivative(t, state, command):
            return state[1], ({scale} * command[0] - self.drag * state[1]) / self.mass
        return Equations(derivative, lambda t, state, command: state[:1])
"""


def refined(folder: Path, scale: float) -> Refinement:
    """Two logs of a mass with quadratic drag, the place in 1/scale m, and what refine says of them."""
    folder.mkdir()
    (folder / "mass.py").write_text(MODEL.format(scale=scale, noise=NOISE, mass=MASS, drag=DRAG))
    for seed in (1, 2):
        rng, time = np.random.default_rng(seed), times(15.0)
        waves = zip((1.2, 0.8, 0.5), (0.9, 2.3, 5.1), rng.uniform(0.0, 2.0 * math.pi, 3), strict=True)
        force = np.sum([a * np.sin(w * time + p) for a, w, p in waves], axis=0)
        states = [np.zeros(2)]
        for u in force[:-1]:

            def rates(_: float, x: np.ndarray, u: float = u) -> list[float]:
                return [x[1], (u - DRAG * x[1] - PULL * abs(x[1]) * x[1]) / MASS]

            states.append(solve_ivp(rates, (0.0, 0.02), states[-1], rtol=1e-8, atol=1e-10).y[:, -1])
        place = np.array(states)[:, 0] + NOISE * rng.standard_normal(time.size)
        write_log(folder / f"{seed}.csv", {"time": time, "force": force, "place": scale * place})
    (folder / "study.yaml").write_text("model: mass.py:Mass\nlogs: {estimation: [1.csv, 2.csv]}\n")
    return refine(folder / "study.yaml", folder / "out")


@pytest.fixture(scope="module")
def metres(tmp_path_factory: pytest.TempPathFactory) -> Refinement:
    return refined(tmp_path_factory.mktemp("units") / "m", 1.0)


@pytest.fixture(scope="module")
def millimetres(tmp_path_factory: pytest.TempPathFactory) -> Refinement:
    return refined(tmp_path_factory.mktemp("units") / "mm", 1000.0)


@pytest.mark.thorough
def test_what_a_nameless_term_takes_away_does_not_depend_on_the_unit(
    metres: Refinement, millimetres: Refinement
) -> None:
    here, there = (r.record["residual"] for r in (metres, millimetres))
    assert metres.record["verdict"] == millimetres.record["verdict"] == "unexplained"
    assert (here["equation"], here["signals"]) == (there["equation"], there["signals"])
    assert here["share"] > 0.8
    # the range of the process noise is interpolated on a grid of ln q, on which the two lie differently
    assert there["share"] == pytest.approx(here["share"], abs=2e-3)
