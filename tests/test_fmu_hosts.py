"""The FMUs in two simulators that are not ours: the same numbers there.

Both co-simulate by Jacobi: every FMU steps with what the others had at the start of the step. They initialize
as the standard has it, exchanging outputs in initialization mode until they have settled, so that row 0 is ours.

ecos shows, after a step, outputs and inputs at the new time, as our rows do. Parameters and inputs come from the
parameter set that `init` names.
libcosim takes outputs at the new time too, but shows an input only when an FMU has been given it, at the next
step: its inputs stand one row later than ours. Its observer shows zeros before the first step.
Both sum up the time, 2e-13 s off after 10 s; only `battery_sag` and the delay see it.
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.master.master import simulate
from cosim.scenario.scenario import FmuComponent
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.system import build_system
from tests.hosts_fmpy import Instance

ROOT = Path(__file__).resolve().parent.parent
LIBRARIES = Path(sys.prefix) / "lib"  # where pip puts libtbb, which ecos is linked to
STEP = 0.02  # [s]

NEEDS = {"ecos": "ecospy", "libcosim": "libcosimpy"}
MISSING = {host: importlib.util.find_spec(package) is None for host, package in NEEDS.items()}
MISSING["ecos"] |= not list(LIBRARIES.glob("libtbb.so*"))
HOSTS = pytest.mark.parametrize(
    "host",
    [
        pytest.param(
            host,
            marks=pytest.mark.skipif(MISSING[host], reason=f"needs {package}: pip install {package} tbb"),
        )
        for host, package in NEEDS.items()
    ],
)
pytestmark = pytest.mark.hosts

# Rounding (of 12° in radians, of summed time) shows at 1e-15 in the loop, which is stable and does not amplify it;
# a value one sample late shows at 1e-3. 1e-9 is six decades from either.
AGREEMENT = 1e-9


def run_in(host: str, job: dict[str, Any]) -> np.ndarray:
    """Rows of `job["columns"]`, in a process of its own: a host that crashes does not take the tests along."""
    done = subprocess.run(
        [sys.executable, "-m", f"tests.hosts_{host}"],
        input=json.dumps(job),
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, "LD_LIBRARY_PATH": str(LIBRARIES)},
        check=False,
    )
    assert done.returncode == 0, (done.returncode, done.stderr)
    return np.array(json.loads(done.stdout))


@HOSTS
def test_the_plant_alone_moves_as_in_fmpy(host: str, plant_fmu: Path) -> None:
    start: dict[str, float | bool] = {
        "x_start": 1.0, "psi_start": 0.3, "vx_start": 0.2, "phi_start": 0.01, "mass": 0.8, "roll_ground_effect": False,
        "tilt_right": 0.1, "tilt_left": 0.05, "duty_right": 6.45, "coulomb_friction.force": 0.02,
        "actuator_second_order.natural_frequency": 15.0, "servo_backlash.width": 0.02, "battery_sag.drop": 0.1,
    }  # fmt: skip
    with Instance(plant_fmu) as plant:
        names = plant.names("output")
        rows = [plant.initialize(start).outputs()]
        rows += [plant.step(STEP * k, STEP) for k in range(200)]
    want = np.array([[row[n] for n in names] for row in rows])
    job = {"fmus": {"plant": str(plant_fmu)}, "start": {"plant": start}, "connections": [], "step": STEP, "steps": 200}
    got = run_in(host, {**job, "columns": [f"plant.{n}" for n in names]})
    first = 1 if host == "libcosim" else 0
    np.testing.assert_allclose(got[first:], want[first:], rtol=0, atol=AGREEMENT)
    assert np.ptp(want, axis=0).min() > 1e-4  # every output has moved


@pytest.mark.thorough
@HOSTS
def test_both_fmus_coupled_move_as_under_our_master(host: str, project: Path) -> None:
    file = ScenarioFile(project / "scenarios" / "regulate.yaml", ["algorithm=jacobi", "noise=off", "duration=6"])
    scenario, system = file.scenario, build_system(file)
    ours = simulate(system, scenario.steps, scenario.step)
    fmus = {n: c for n, c in scenario.components.items() if isinstance(c, FmuComponent)}
    start = {n: {**component.start} for n, component in fmus.items()}
    assert start["controller"].pop("tilt_max") == "12 deg"
    start["controller"]["tilt_max"] = math.radians(12)
    job = {
        "fmus": {n: str(file.resolve(c.fmu)) for n, c in fmus.items()},
        "start": {n: {k: v if isinstance(v, str) else float(v) for k, v in s.items()} for n, s in start.items()},
        # the references rest at zero, where the controller's inputs are by themselves
        "connections": [(c.source, c.target) for c in scenario.connections if c.source.partition(".")[0] in fmus],
        "step": scenario.step,
        "steps": scenario.steps,
    }
    inputs = [target for _, target in job["connections"]]
    outputs = [c for c in ours.columns if c.partition(".")[0] in fmus and c not in inputs and "_ref" not in c]
    assert len(outputs) == 15 + 11
    got = run_in(host, {**job, "columns": [*outputs, *inputs]})
    want = np.column_stack([ours[c] for c in (*outputs, *inputs)])
    n = len(outputs)
    np.testing.assert_allclose(got[1:, :n], want[1:, :n], rtol=0, atol=AGREEMENT)
    if host == "libcosim":
        np.testing.assert_allclose(got[1:, n:], want[:-1, n:], rtol=0, atol=AGREEMENT)
    else:
        np.testing.assert_allclose(got, want, rtol=0, atol=AGREEMENT)
    # Gauss-Seidel is another trajectory: the comparison tells one sample of delay
    serial = simulate(build_system(ScenarioFile(file.path, ["noise=off", "duration=6"])), 300, STEP)
    assert np.abs(serial["plant.x"] - ours["plant.x"]).max() > 1e-3
