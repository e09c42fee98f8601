"""Refinement of FMUs: free runs, delivered FMU, crashes, names of variables, whole studies."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cosim
from cosim.core.errors import InputError
from cosim.estimation.kernel.backend import RemoteLibraryKernel
from cosim.estimation.posing import build_problem
from cosim.estimation.subject.fmu_subject import FmuSubject
from cosim.experiment.question import ask
from cosim.refinement.study import Study, read_study
from cosim.refinement.workflow import failure_warnings
from tests.blind.fmu_build import build
from tests.logs import integrated, write_log
from tests.warm import cosim as command

STEP, NOISE = 0.02, {"current": 0.01, "angle": 0.002, "speed": 0.05}
RESISTANCE, INDUCTANCE, CONSTANT, INERTIA, DAMPING = 1.2, 6e-3, 0.05, 2e-4, 1e-4


def run_motor(path: Path, seed: int, friction: float = 0.0, seconds: float = 8.0, size: float = 1.0) -> Path:
    """Write a log of the motor with dry friction."""
    rng = np.random.default_rng(seed)
    time = STEP * np.arange(round(seconds / STEP) + 1)
    levels = rng.uniform(-6.0, 6.0, 1 + int(seconds))
    voltage = size * (levels[(time // 1.0).astype(int)] + np.sin(7.0 * time))
    load = size * 0.002 * np.sign(np.sin(1.3 * time + seed))

    def rates(x: Any, row: Any) -> list[float]:
        (i, _, w), (u, torque) = x, row
        dry = friction * math.tanh(w / 0.2)
        return [
            (u - RESISTANCE * i - CONSTANT * w) / INDUCTANCE,
            w,
            (CONSTANT * i - DAMPING * w - torque - dry) / INERTIA,
        ]

    states = integrated(rates, [0.0] * 3, np.column_stack([voltage, load]), STEP)
    readings = {n: y + NOISE[n] * rng.standard_normal(time.size) for n, y in zip(NOISE, states.T, strict=True)}
    return write_log(path, {"time": time, "voltage": voltage, "load_torque": load, **readings})


def write_study(folder: Path, fmu: Path, logs: Sequence[Path], sealed: Sequence[Path] = (), **keys: Any) -> Path:
    """Write study.yaml."""
    lists = {"estimation": [p.name for p in logs], "validation": [p.name for p in sealed]}
    path = folder / "study.yaml"
    path.write_text(json.dumps({"model": fmu.name, "logs": lists, **keys}))
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("motor")
    for k, name in enumerate(("e1", "e2", "v1")):
        run_motor(folder / f"{name}.csv", k)
        run_motor(folder / f"dry_{name}.csv", k + 10, friction=0.004)
    return folder


def study_of_way(folder: Path, way: str) -> Study:
    """Return the study of a motor's FMU."""
    fmu = build(folder / f"{way}.fmu", "dc_motor", 2, ways=(way,))
    return read_study(write_study(folder, fmu, [folder / "e1.csv", folder / "e2.csv"], noise=NOISE))


@pytest.mark.parametrize("way", ["model_exchange", "co_simulation"])
def test_terms_stand_at_inputs_pairs_storages_and_outputs(folder: Path, way: str) -> None:
    names = {c.name for c in study_of_way(folder, way).subject.candidates(["voltage", "load_torque"])}
    assert {"dead_band_at_voltage", "coulomb_at_speed", "bias_at_angle", "delay", "resistance"} <= names
    assert ("leak_at_current" in names) is (way == "model_exchange")


@pytest.mark.parametrize("fault", ["crashes", pytest.param("hangs", marks=pytest.mark.thorough)])
def test_a_crash_or_a_hang_costs_one_evaluation(folder: Path, fault: str) -> None:
    fmu = build(folder / f"{fault}.fmu", "dc_motor", ways=("model_exchange",), fault=fault)
    study = read_study(write_study(folder, fmu, [folder / "e1.csv"], noise=NOISE))
    problem = build_problem(study.subject, study.logs, noise=NOISE)
    assert isinstance(problem.kernel, RemoteLibraryKernel)
    problem.kernel.limits = problem.kernel.limits.model_copy(update={"load": 3.0})
    good, bad, again = (
        problem.score({**problem.values, "resistance": size * RESISTANCE}, problem.plain).nll
        for size in (1.0, 2.0, 1.0)
    )
    assert (bad, again) == (np.inf, good)
    assert len([*failure_warnings(problem)]) == 1
    rows, x0, memory = [0, 5, 60], np.tile(problem.x0[0], (3, 1)), np.zeros((3, problem.layout.memory))
    p = problem.parameters({}, 0)
    for row, run in zip(rows, problem.simulate_from({}, 0, (rows, x0, memory), 2), strict=True):
        single = problem.kernel.simulate(problem.logs[0].rows(0, row + 3), p, x0[0], memory[0], first=row)
        np.testing.assert_allclose(run.outputs, single.outputs[row:], rtol=1e-9, atol=1e-12)
    (failed,) = problem.simulate_from({"resistance": 2.0 * RESISTANCE}, 0, (rows[1:2], x0[:1], memory[:1]), 2)
    assert failed.outputs.shape == (3, len(problem.layout.outputs))
    assert np.isnan(failed.outputs).all()


def test_names_of_the_fmu_are_those_of_study_and_log(tmp_path: Path) -> None:
    fmu, time = build(tmp_path / "drive.fmu", "drive"), 0.01 * np.arange(600)
    log = write_log(tmp_path / "e1.csv", {"time": time, "torque": np.sign(np.sin(3.0 * time)), "motor.phi": time})
    study = read_study(write_study(tmp_path, fmu, [log], tolerance={"motor.J": 0.1}, noise={"motor.phi": 1e-3}))
    assert study.content.tolerance == {"motor_J": 0.1}
    assert {*study.logs[0].outputs} == {"motor_phi"}


def test_faults_of_a_study_of_an_fmu(folder: Path) -> None:
    fmu, log = build(folder / "motor.fmu", "dc_motor"), folder / "e1.csv"
    for path, logs, keys, words in (
        (fmu, [folder / "none.csv", folder / "no.csv"], {"terms": "nothing.py"}, ("none.csv", "no.csv", "nothing.py")),
        (fmu, [log], {"tolerance": {"resistence": 0.1}}, ("resistence", "no base parameter")),
        (folder / "missing.fmu", [log], {}, ("no such file",)),
        (fmu, [log], {"delivery": "ssp"}, (":1:",)),
        (fmu, [log, folder / "e2.csv"], {"per_log": ["resistance"]}, ("per_log",)),
    ):
        with pytest.raises(InputError) as raised:
            cosim.refine(write_study(folder, path, logs, **keys), folder / "out")
        assert all(word in str(raised.value) for word in words)


def test_a_study_of_an_fmu_without_a_c_compiler_is_refused_before_the_work(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fmu = build(folder / "motor.fmu", "dc_motor")
    monkeypatch.setenv("CC", "no-such-compiler")
    monkeypatch.setattr("cosim.fmi.native.compiler.can_cross", lambda: False)
    with pytest.raises(InputError, match=r"fmu-cosim\[refine\]") as refused:
        cosim.refine(write_study(folder, fmu, [folder / "e1.csv"]), folder / "refused")
    assert [fault.file for fault in refused.value.faults] == [fmu]
    assert not (folder / "refused").exists()


def test_a_replay_leaves_the_study_that_goes_on(folder: Path, tmp_path: Path) -> None:
    fmu = build(folder / "motor.fmu", "dc_motor")
    log, out = tmp_path / "log.csv", tmp_path / "out"
    log.write_text((folder / "dry_e1.csv").read_text().replace("speed", "w", 1))
    done = command("replay", log, "--plant", fmu, "--column", "w=speed", "--no-report", "--out", out)
    assert done.returncode == 0, done.stderr
    assert f"next: cosim refine {out / 'study.yaml'}" in done.stdout
    study = read_study(out / "study.yaml")
    assert (study.content.columns, len(study.logs)) == ({"w": "speed"}, 1)
    cosim.replay(folder / "e1.csv", out, fmu, report=False, force=True)  # nothing is missing
    assert not (out / "study.yaml").exists()


def test_a_replay_of_a_refined_fmu_names_the_claimed_error_of_a_sensor(folder: Path, tmp_path: Path) -> None:
    """The FMU holds no error of a sensor; a further refine would only find it again."""
    parameters = {"factor": {"value": 1.1, "unit": "1", "ci95": [1.09, 1.11]}}
    entry = {"name": "scale_at_speed", "kind": "sensor", "parameters": parameters, "probability": 1.0}
    fmu = build(tmp_path / "plant.fmu", "dc_motor")
    (tmp_path / "refine.json").write_text(json.dumps({"effects": [entry]}))
    table = np.genfromtxt(folder / "e1.csv", delimiter=",", names=True)
    table["speed"] *= 1.1
    log = write_log(tmp_path / "log.csv", {name: table[name] for name in table.dtype.names})
    done = command("replay", log, "--plant", fmu, "--no-report", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "scale_at_speed" in done.stdout
    assert "cosim refine" not in done.stdout
    assert not (tmp_path / "out" / "study.yaml").exists()


@pytest.mark.thorough
@pytest.mark.parametrize("way", ["model_exchange", "co_simulation"])
def test_dry_friction_is_named_and_delivered(folder: Path, way: str, tmp_path: Path) -> None:
    fmu = build(folder / f"{way}.fmu", "dc_motor", ways=(way,))
    logs, sealed = [folder / "dry_e1.csv", folder / "dry_e2.csv"], [folder / "dry_v1.csv"]
    file = write_study(folder, fmu, logs, sealed, noise=NOISE, tolerance=dict.fromkeys(("resistance", "inertia"), 0.05))
    refined = cosim.refine(file, tmp_path)
    (entry,) = refined.effects
    assert (refined.verdict, entry["name"]) == ("effect_found", "coulomb_at_speed")
    low, high = entry["parameters"]["level"]["ci95"]
    assert low - (high - low) < 0.004 < high + (high - low)
    assert (tmp_path / "plant.fmu").is_file()
    assert refined.record["replays"]["apart"] < 1e-9  # the delivered FMU and the model of the filter
    error = refined.record["error"]
    assert error["after"]["validation"]["speed"] < 0.2 * error["before"]["validation"]["speed"]


def test_a_question_about_an_fmu_says_how_far_each_input_may_go(folder: Path, tmp_path: Path) -> None:
    fmu, frictions = build(folder / "motor.fmu", "dc_motor"), ["coulomb_at_speed", "viscous_at_speed"]
    question = ask(str(fmu), frictions, limits=["voltage=6", "load_torque=0.002"])
    assert question.pairs == (tuple(frictions),)
    assert isinstance(question.subject, FmuSubject)
    assert question.limits["voltage"] == 6.0
    with pytest.raises(InputError, match=r"load_torque .*0.* --limit load_torque=VALUE"):
        ask(str(fmu), limits=["voltage=6"])
    study = write_study(folder, fmu, [folder / "e1.csv"], noise=NOISE)
    record = {"study": str(study), "rivals": frictions, "candidates": [], "hidden": [], "measured": [*NOISE]}
    (tmp_path / "refine.json").write_text(json.dumps(record))
    assert ask(str(tmp_path)).ranges["voltage"][1] < 8.0  # that of the logs, since the FMU declares none
