"""FMUs of the blind suite: valid in FMPy, and consistent with their recorded true effects."""

from __future__ import annotations

import platform
from pathlib import Path

import fmpy
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cosim.fmi.native.compiler import compiler
from tests.blind.field_rig import Floats, Run
from tests.blind.fmu_build import PLANTS, WAYS, build
from tests.blind.fmu_rig import FmuRig, place
from tests.blind.fmu_truths import RIGS
from tests.cases import some

pytestmark = pytest.mark.skipif(
    compiler() is None or platform.system() != "Linux", reason="needs a C compiler and Linux folders"
)
WITH_TRUTH = [plant for plant in PLANTS if (plant, WAYS[0]) in RIGS]


def short_run(rig: FmuRig, rows: int) -> Run:
    """Return the first rows of a log without disturbance that begins in motion."""
    rng = np.random.default_rng(3)
    commands = rig.drive(rng)[rng.integers(200, 400) :][:rows]
    starts = [rig.begin(rng) for _ in range(8)]
    return Run(rig.step * np.arange(rows), commands, np.zeros((rows, len(rig.pushes))), max(starts, key=np.ptp))


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("plant", some(WITH_TRUTH, every=3))
def test_an_fmu_agrees_with_its_truth_within_a_tenth_of_the_noise(tmp_path: Path, plant: str, way: str) -> None:
    rig, declared = RIGS[plant, way], PLANTS[plant]
    run = short_run(rig, 60)
    base = {name: value * 1.03 for name, (value, _) in rig.sheet.items()}
    truth = rig.course(rig.numbers(base, {}), run)
    starts = dict(zip((v.name for v in declared.states), truth.states[0].tolist(), strict=True))
    starts |= {v.name: base[place(v.name)] for v in declared.parameters}
    held = np.zeros(2 * len(run.times) - 1, dtype=[("time", float), *((u, float) for u in rig.inputs)])
    held["time"] = np.repeat(run.times, 2)[1:]
    for number, name in enumerate(rig.inputs):
        held[name] = np.repeat(run.commands[:, number], 2)[:-1]  # from row to row
    version = 2 + (list(PLANTS).index(plant) + WAYS.index(way)) % 2
    more = {"solver": "CVode", "relative_tolerance": 1e-7} if way == "model_exchange" else {}
    result = fmpy.simulate_fmu(
        str(build(tmp_path / "plant.fmu", plant, version, ways=(way,))), stop_time=run.times[-1],
        output_interval=rig.step, step_size=rig.step, input=held, start_values=starts, record_events=False,
        output=list(rig.outputs), **more,
    )  # fmt: skip
    at = np.rint(result["time"] / rig.step).astype(int)
    exact = np.abs(result["time"] - at * rig.step) < 1e-9 * rig.step + 1e-12
    assert set(range(60)) <= set(at[exact].tolist())
    for number, (output, sigma) in enumerate(rig.outputs.items()):
        gap = result[output][exact] - truth.readings[at[exact], number]
        assert np.max(np.abs(gap)) < 0.1 * sigma, output


@pytest.mark.parametrize(
    ("plant", "truth"),
    [
        ("drive", {"coulomb_at_load_w": {"level": 0.2}, "lag_at_motor_w": {"time": 0.01}}),
        ("pendulum", {"cogging_at_v": {"sine": 0.2, "cosine": 0.1, "period": 0.4}}),
        ("cylinder", {"leak_at_p_a": {"coefficient": 0.5}}),
    ],
)
def test_a_truth_agrees_with_dop853(plant: str, truth: dict[str, dict[str, float]]) -> None:
    rig = RIGS[plant, WAYS[0]]
    run, p = short_run(rig, 40), rig.numbers({}, truth)
    course, (rate, look) = rig.course(p, run), rig.bind(Floats, p)
    state, quiet, tolerances = course.states[0], [0.0] * len(rig.pushes), {"rtol": 1e-9, "atol": 1e-9}
    for row, u in enumerate(run.commands[:-1].tolist()):
        span = run.times[row], run.times[row] + rig.step
        done = solve_ivp(lambda t, x, u=u: rate(t, x.tolist(), u, quiet), span, state, "DOP853", **tolerances)
        state = done.y[:, -1]
        reading = np.array(look(run.times[row + 1], state.tolist(), quiet))
        assert np.all(np.abs(reading - course.readings[row + 1]) < 0.02 * np.array(list(rig.outputs.values())))
