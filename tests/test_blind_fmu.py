"""The FMUs of the blind suite: sound in FMPy, and each fault of `fmu_build` is what it says."""

from __future__ import annotations

import platform
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cosim.fmi.native.compiler import compiler
from tests.blind.field_rig import Floats, Run
from tests.blind.fmu_build import FAULTS, PLANTS, WAYS, build
from tests.blind.fmu_rig import FmuRig, place
from tests.blind.fmu_truths import RIGS
from tests.cases import some

pytestmark = pytest.mark.skipif(
    compiler() is None or platform.system() != "Linux", reason="needs a C compiler and Linux folders"
)
KINDS = {"model_exchange": "ModelExchange", "co_simulation": "CoSimulation"}
WITH_TRUTH = [plant for plant in PLANTS if (plant, WAYS[0]) in RIGS]


def simulated(path: Path, plant: str, way: str, count: int = 50, **more: Any) -> np.ndarray:
    """Simulate 50 rows with constant inputs in FMPy."""
    declared = PLANTS[plant]
    starts = {v.name: v.start + 0.2 for v in declared.inputs}
    step = 10.0 * declared.inner
    more = {"output_interval": step, "start_values": starts, "logger": lambda *_: None} | more
    if way == "model_exchange":
        more |= {"relative_tolerance": 1e-6}
    result = fmpy.simulate_fmu(str(path), fmi_type=KINDS[way], stop_time=count * step, record_events=False, **more)
    return np.column_stack([result[n] for n in declared.output_names])


@pytest.mark.parametrize("fault", some(FAULTS, every=3))
def test_each_fault_is_a_valid_fmu(tmp_path: Path, fault: str) -> None:
    for version in (2, 3):
        path = build(tmp_path / f"{version}.fmu", "drive", version, ways=WAYS, fault=fault)
        description = fmpy.read_model_description(str(path))
        assert description.modelExchange
        assert description.coSimulation
        assert bool([v for v in description.modelVariables if v.causality == "parameter"]) == FAULTS[fault].parameters


def fmu(tmp_path: Path, fault: str) -> Path:
    return build(tmp_path / f"{fault}.fmu", "drive", ways=WAYS, fault=fault)


def test_parameters_are_forgotten_when_set_before_initialization(tmp_path: Path) -> None:
    sound, bad = fmu(tmp_path, ""), fmu(tmp_path, "forgets_parameters")
    heavy = {"torque": 1.0, "load.J": 0.3}  # FMPy sets fixed parameters before initialization mode
    plain = simulated(sound, "drive", "co_simulation", start_values={"torque": 1.0})
    assert np.max(np.abs(simulated(sound, "drive", "co_simulation", start_values=heavy) - plain)) > 1e-3
    assert np.array_equal(simulated(bad, "drive", "co_simulation", start_values=heavy), plain)


@pytest.mark.parametrize("fault", ["own_step", "hidden_own_step"])
def test_short_steps_are_whole_own_steps(tmp_path: Path, fault: str) -> None:
    def angle(fault: str, step: float) -> float:
        path, steps = str(fmu(tmp_path, fault)), {"step_size": step, "output_interval": step, "stop_time": 0.1}
        result = fmpy.simulate_fmu(path, fmi_type="CoSimulation", start_values={"torque": 0.2}, **steps)
        return float(result["motor.phi"][-1])

    assert angle(fault, 0.05) == pytest.approx(angle("", 0.05), rel=0.05)
    assert angle(fault, 0.01) > 4.0 * angle("", 0.01)


# -- truths -------------------------------------------------------------------------------------------------


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
    version = 2 + list(PLANTS).index(plant) % 2 if way == WAYS[0] else 3 - list(PLANTS).index(plant) % 2
    more = {"solver": "CVode", "relative_tolerance": 1e-7} if way == "model_exchange" else {}
    path = build(tmp_path / "plant.fmu", plant, version, ways=(way,))
    result = fmpy.simulate_fmu(
        str(path), fmi_type=KINDS[way], stop_time=run.times[-1], output_interval=rig.step, step_size=rig.step,
        input=held, start_values=starts, record_events=False, output=list(rig.outputs), **more,
    )  # fmt: skip
    at = np.rint(result["time"] / rig.step).astype(int)
    exact = np.abs(result["time"] - at * rig.step) < 1e-9 * rig.step + 1e-12
    assert set(range(60)) <= set(at[exact].tolist())
    for number, (output, sigma) in enumerate(rig.outputs.items()):
        gap = result[output][exact] - truth.readings[at[exact], number]
        assert np.max(np.abs(gap)) < 0.1 * sigma, output


@pytest.mark.parametrize("plant", WITH_TRUTH)
def test_the_sheet_of_a_truth_is_that_of_the_fmu(plant: str) -> None:
    rig, declared = RIGS[plant, WAYS[0]], PLANTS[plant]
    assert {place(v.name): v.start for v in declared.parameters} == {n: v for n, (v, _) in rig.sheet.items()}
    assert [v.name for v in declared.inputs] == list(rig.inputs)
    assert [v.name for v in declared.states] == list(rig.states)
    assert set(rig.outputs) <= set(declared.output_names)


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
    course = rig.course(p, run)
    rate, look = rig.bind(Floats, p)
    state, quiet = course.states[0], [0.0] * len(rig.pushes)
    for row in range(39):
        u, begin = run.commands[row].tolist(), run.times[row]
        done = solve_ivp(
            lambda t, x, u=u: rate(t, x.tolist(), u, quiet),
            (begin, begin + rig.step),
            state,
            "DOP853",
            rtol=1e-9,
            atol=1e-9,
        )
        state = done.y[:, -1]
        reading = np.array(look(run.times[row + 1], state.tolist(), quiet))
        assert np.all(np.abs(reading - course.readings[row + 1]) < 0.02 * np.array(list(rig.outputs.values())))
