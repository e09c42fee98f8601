"""Refined FMUs as SSPs: the original and the terms beside it, built and run without a compiler."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pythonfmu.builder import FmuBuilder

import cosim
from cosim.base.errors import InputError
from cosim.fmi.native.compiler import NoCompiler, compiler
from cosim.kernel.kernel import Data
from cosim.refinement.study import Study, read_study
from cosim.subject.effect_ssp import EffectSsp, NotInSsp
from cosim.subject.fmu_subject import FmuSubject
from cosim.subject.interface import Workplace
from cosim.subject.ssp_replayer import SspReplayer
from cosim.wrapping.wrap import Wrapper
from tests.logs import write_log
from tests.slider import slide, slider_fmu, slider_log
from tests.test_refine_fmu import write_study

TANK = Path(__file__).resolve().parents[1] / "examples" / "tanks" / "tank.py"
ROW, ROWS, PARTS = 0.5, 41, 8  # time between rows [s], rows, and steps of the SSP in a row
STEP = ROW / PARTS
TIME = STEP * np.arange((ROWS - 1) * PARTS + 1)
Array = NDArray[np.float64]


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide every C compiler."""
    monkeypatch.setenv("CC", "no-such-compiler")
    monkeypatch.setattr("cosim.fmi.native.compiler.can_cross", lambda: False)
    assert compiler() is None


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    """Return a study of a tank by pythonfmu, whose owner wants an SSP."""
    folder = tmp_path_factory.mktemp("tank")
    FmuBuilder.build_FMU(TANK, folder)
    time = ROW * np.arange(2 * ROWS)
    level = 1.0 + 0.01 * np.sin(time)
    columns = {"time": time, "inflow": inflow(time)}
    logs = [write_log(folder / f"e{k}.csv", {**columns, "level": level + 1e-3 * k}) for k in range(2)]
    return read_study(write_study(folder, folder / "Tank.fmu", logs, delivery="ssp"))


def inflow(time: Array) -> Array:
    """Return the commands of the logs, held from row to row."""
    return np.where(ROW * np.floor(time / ROW + 1e-9) % 8.0 < 4.0, 0.05, 0.01)


def tank(flow: Array, level: float = 1.0, leak: float = 0.0) -> Array:
    """Return the level of examples/tanks/tank.py at each step, from the flow over each step.

    Args:
        leak: Loss of the level, relative to it [1/s].
    """
    levels, parts = [level], round(STEP / 0.01)
    for q in flow[:-1]:
        for _ in range(parts):
            level += STEP / parts * ((q - 0.02 * math.sqrt(max(level, 0.0))) / 0.5 - leak * level)
        levels.append(level)
    return np.array(levels)


def late(command: Array, delay: float) -> Array:
    """Return the mean of a held command over each step, late by a delay."""
    middle = TIME[:, None] + STEP * (np.arange(200) + 0.5) / 200
    return np.asarray(inflow(np.maximum(middle - delay, 0.0)).mean(axis=1))


def lagged(command: Array, constant: float) -> Array:
    """Return the mean of a held command over each step, behind a lag."""
    values, state, decay = [], command[0], math.exp(-STEP / constant)
    for u in command:
        values.append(u + (state - u) * (1.0 - decay) * constant / STEP)
        state = u + (state - u) * decay
    return np.array(values)


def subject_of(study: Study, **claims: float) -> FmuSubject:
    subject = study.subject
    assert isinstance(subject, FmuSubject)
    return subject.refined({name.replace("__", "."): value for name, value in claims.items()})


def free_run(subject: FmuSubject, folder: Path) -> Array:
    """Return the level at each row, by a free run of the SSP."""
    data = Data(ROW, 0.0, inflow(ROW * np.arange(ROWS))[:, None], np.full((ROWS, 1), np.nan), 1)
    with Workplace(folder, in_process=True) as place:
        replayer = subject.replayer(place)
        assert isinstance(replayer, SspReplayer)
        return np.asarray(replayer.free_run(data, {})[:, 0])


@pytest.mark.usefixtures("no_compiler")
def test_a_leak_comes_in_through_the_inflow(study: Study, tmp_path: Path) -> None:
    level = free_run(subject_of(study, leak_at_level__coefficient=0.05), tmp_path)
    assert level == pytest.approx(tank(inflow(TIME), leak=0.05)[::PARTS], abs=2.0 * STEP * 0.05)  # late
    assert np.abs(level - tank(inflow(TIME))[::PARTS]).max() > 0.1


@pytest.mark.usefixtures("no_compiler")
@pytest.mark.parametrize(
    ("claim", "change"),
    [
        pytest.param({"bias_at_inflow__value": 0.01}, lambda u: u + 0.01, marks=pytest.mark.thorough),
        pytest.param(
            {"dead_band_at_inflow__width": 0.02}, lambda u: u - np.clip(u, -0.02, 0.02), marks=pytest.mark.thorough
        ),
        ({"lag_at_inflow__time": 1.5}, lambda u: lagged(u, 1.5)),
        ({"delay__time": 1.3}, lambda u: late(u, 1.3)),
    ],
    ids=["bias", "dead band", "lag", "delay"],
)
def test_a_term_at_an_input_acts_as_its_equation_one_step_late(
    study: Study, tmp_path: Path, claim: dict[str, float], change: Callable[[Array], Array]
) -> None:
    level = free_run(subject_of(study, **claim), tmp_path)
    flow = change(inflow(TIME))
    flow = np.concatenate([flow[:1], flow[:-1]])  # Jacobi passes what an FMU has computed in its last step
    np.testing.assert_allclose(level, tank(flow)[::PARTS], rtol=1e-7)


@pytest.mark.usefixtures("no_compiler")
def test_a_sensor_reads_what_its_equation_says_one_step_late(study: Study, tmp_path: Path) -> None:
    errors = {"bias_at_level__value": 0.2, "scale_at_level__value": 1.5, "latency_at_level__value": 3 * STEP}
    subject = subject_of(study, **errors, area=0.25)
    ssp = EffectSsp(subject.loaded, subject.structure, subject._description)
    path = ssp.write(tmp_path / "x.ssp")
    run = cosim.run(path, set={"duration": 4.0, "components.original.start.inflow": 0.05}, in_process=True)
    true, read = run["original.level"], run["sensor_terms.level"]
    assert true[-1] > 1.3  # twice as fast as with the area of the FMU
    np.testing.assert_allclose(read[8:], 1.5 * (true[4:-4] + 0.2), rtol=1e-9)


def test_a_force_reads_the_velocity_of_the_original(tmp_path: Path) -> None:
    fmu, keys = slider_fmu(tmp_path / "slider.fmu"), {"mass": 1.0, "gain": 2.0, "offset": 0.0}
    logs = [slider_log(tmp_path / f"e{k}.csv", {**keys, "damping": 0.5}, seed=k) for k in range(2)]
    study = read_study(write_study(tmp_path, fmu, logs, delivery="ssp"))
    columns = slide(0.05 * np.arange(201), {**keys, "damping": 0.5 + 2.0 * 0.2})
    data = Data(0.05, 0.0, columns["force"][:, None], np.full((201, 2), np.nan), 1)
    with Workplace(tmp_path, in_process=True) as place:
        replayer = subject_of(study, viscous_at_velocity__coefficient=0.2).replayer(place)
        assert isinstance(replayer, SspReplayer)
        rows = replayer.free_run(data, {})
    velocity = columns["velocity"]
    assert np.abs(rows[:, 1] - velocity).max() < 0.02 * np.ptp(velocity)  # two steps of 1/8 row late, of some 20 rows


def test_terms_inside_the_original_are_refused(study: Study) -> None:
    subject = subject_of(study)
    parts = EffectSsp(subject.loaded, subject.structure, SimpleNamespace(coSimulation=None))
    with pytest.raises(NotInSsp, match=r"Tank.fmu offers no co-simulation"):
        parts.check()


def test_a_model_has_no_ssp(tmp_path: Path) -> None:
    (tmp_path / "study.yaml").write_text("delivery: ssp\nlogs: {estimation: [a.csv]}\n")
    with pytest.raises(InputError, match=r"study.yaml:1:1: delivery: ssp is for an FMU, and base is none"):
        read_study(tmp_path / "study.yaml")


@pytest.mark.thorough
def test_an_ssp_takes_the_place_of_an_fmu_that_cannot_be_built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> Any:
        raise NoCompiler("there is no compiler for it.")

    fmu = slider_fmu(tmp_path / "slider.fmu")
    biased = {"mass": 1.0, "gain": 2.0, "damping": 0.5, "offset": 0.3 * 2.0}  # 0.3 N at the force
    logs = [slider_log(tmp_path / f"e{k}.csv", biased, seed=k + 1) for k in range(3)]
    keys = {"tolerance": {"mass": 0.02}, "candidates": ["bias_at_force", "gain_at_force", "bias_at_position"]}
    path = write_study(tmp_path, fmu, logs[:2], logs[2:], **keys)
    monkeypatch.setattr(Wrapper, "write", refuse)
    refined = cosim.refine(path, tmp_path / "out")
    record = refined.record
    assert [e["name"] for e in record["effects"]] == ["bias_at_force"]
    assert record["replays"]["through"] == "ssp"
    before, after = (record["error"][k]["validation"]["position"] for k in ("before", "after"))
    assert after < 0.05 * before
    assert not (tmp_path / "out" / "plant.fmu").exists()
    assert any("there is no compiler for it. plant.ssp is delivered" in w for w in record["warnings"])
    shutil.rmtree(tmp_path / "again", ignore_errors=True)
    assert cosim.run(tmp_path / "out" / "plant.ssp", tmp_path / "again")["original.position"].size > 1
