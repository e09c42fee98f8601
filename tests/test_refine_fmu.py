"""Refinement of FMUs: filter over a library, free runs, delivered FMU, crashes, names of variables, whole studies."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import cosim
from cosim.core.errors import InputError
from cosim.estimation.kernel.remote_kernel import RemoteLibraryKernel
from cosim.estimation.posing import build_problem
from cosim.estimation.problem import Problem
from cosim.estimation.subject.fmu_subject import FmuSubject
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.experiment.excite import excite
from cosim.experiment.question import ask
from cosim.model import Equations, Model, Namespace, Quantity, Values, parameter
from cosim.model.model import Number
from cosim.refinement.study import Study, read_study
from cosim.refinement.workflow import failure_warnings
from cosim.residuals.drive import Drive, log_of_fmu
from tests.blind.fmu_build import build
from tests.logs import write_log
from tests.warm import cosim as command

STEP, NOISE = 0.02, {"current": 0.01, "angle": 0.002, "speed": 0.05}
RESISTANCE, INDUCTANCE, CONSTANT, INERTIA, DAMPING = 1.2, 6e-3, 0.05, 2e-4, 1e-4


@dataclass(frozen=True, kw_only=True)
class Motor(Model):
    """The equations of the blind suite's motor, written again."""

    base_states = (
        Quantity("current", "A", ""),
        Quantity("angle", "rad", ""),
        Quantity("speed", "rad/s", ""),
    )
    inputs = (Quantity("voltage", "V", ""), Quantity("load_torque", "N.m", ""))
    outputs = base_states
    forced = ("current", "speed")
    substep = 1e-3

    resistance: float = parameter(RESISTANCE, unit="ohm", doc="")

    def equations(self, m: Namespace) -> Equations:
        """Return the equations of a motor with constant excitation."""

        def derivative(t: Number, state: Values, command: Values) -> Values:
            current, _, speed = state
            voltage, load = command
            rate = (voltage - self.resistance * current - CONSTANT * speed) / INDUCTANCE
            return rate, speed, (CONSTANT * current - DAMPING * speed - load) / INERTIA

        return Equations(derivative, lambda t, state, command: state)


def run_motor(path: Path, seed: int, friction: float = 0.0, seconds: float = 8.0, size: float = 1.0) -> Path:
    """Write a log of the motor with dry friction."""
    rng = np.random.default_rng(seed)
    time = STEP * np.arange(round(seconds / STEP) + 1)
    levels = rng.uniform(-6.0, 6.0, 1 + int(seconds))
    voltage = size * (levels[(time // 1.0).astype(int)] + np.sin(7.0 * time))
    load = size * 0.002 * np.sign(np.sin(1.3 * time + seed))

    def rates(_: float, x: Any, u: float, torque: float) -> list[float]:
        i, _, w = x
        dry = friction * math.tanh(w / 0.2)
        return [
            (u - RESISTANCE * i - CONSTANT * w) / INDUCTANCE,
            w,
            (CONSTANT * i - DAMPING * w - torque - dry) / INERTIA,
        ]

    rows = [np.zeros(3)]
    for u, torque in zip(voltage[:-1], load[:-1], strict=True):
        rows.append(solve_ivp(rates, (0.0, STEP), rows[-1], "LSODA", args=(u, torque), rtol=1e-9, atol=1e-9).y[:, -1])
    states = dict(zip(NOISE, np.array(rows).T, strict=True))
    readings = {n: y + NOISE[n] * rng.standard_normal(time.size) for n, y in states.items()}
    return write_log(path, {"time": time, "voltage": voltage, "load_torque": load, **readings})


def write_study(folder: Path, fmu: Path, logs: Sequence[Path], sealed: Sequence[Path] = (), **keys: Any) -> Path:
    """Write study.yaml."""
    lists = {"estimation": [p.name for p in logs], "validation": [p.name for p in sealed]}
    path = folder / "study.yaml"
    path.write_text(json.dumps({"model": fmu.name, "logs": lists, **keys}))
    return path


@pytest.fixture(scope="module", params=["model_exchange", "co_simulation"])
def way(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("motor")
    for k, name in enumerate(("e1", "e2", "v1")):
        run_motor(folder / f"{name}.csv", k)
        run_motor(folder / f"dry_{name}.csv", k + 10, friction=0.004)
    return folder


def study_of_way(folder: Path, way: str, version: int = 2, prefix: str = "", **keys: Any) -> Study:
    """Return the study of a motor's FMU."""
    fmu = build(folder / f"{way}{version}.fmu", "dc_motor", version, ways=(way,))
    logs = [folder / f"{prefix}{n}.csv" for n in ("e1", "e2")]
    return read_study(write_study(folder, fmu, logs, noise=NOISE, **keys))


@pytest.fixture(scope="module")
def study(folder: Path, way: str) -> Study:
    return study_of_way(folder, way)


def problem_of(study: Study) -> Problem:
    return build_problem(study.subject, study.logs, noise=NOISE, settings=study.settings)


@pytest.mark.parametrize("version", [2, pytest.param(3, marks=pytest.mark.thorough)])
def test_the_filter_over_a_library_is_that_of_its_equations(folder: Path, version: int) -> None:
    study = study_of_way(folder, "model_exchange", version)
    own, library = (
        build_problem(subject, study.logs, noise=NOISE) for subject in (ModelSubject.of(Motor()), study.subject)
    )
    library = replace(library, logs=[replace(log, substeps=own.logs[0].substeps) for log in library.logs])
    assert own.layout.uncertain == library.layout.uncertain
    library = replace(library, P0=own.P0, x0=own.x0)
    noise = own.plain
    (e, s), (f, t) = (p.innovations(p.values, noise, 0) for p in (own, library))
    assert np.nanmax(np.abs(e - f) / np.sqrt(s)) < 1e-5  # slopes of the library are differences
    assert np.nanmax(np.abs(s / t - 1.0)) < 1e-5


def test_a_free_run_is_that_of_the_fmu(folder: Path) -> None:
    study = study_of_way(folder, "co_simulation")
    problem = problem_of(study)
    x0 = np.zeros(len(problem.layout.states))
    data = replace(problem.logs[0], substeps=1)
    run = problem.kernel.simulate(data, problem.numbers(problem.values), x0, np.zeros(problem.layout.memory))
    subject = study.subject
    assert isinstance(subject, FmuSubject)
    log = log_of_fmu(folder / "e1.csv", subject.structure.fmu)
    with Drive(log, subject.structure.fmu) as drive:
        own = drive.run(0, log.rows - 1, {"current": 0.0, "angle": 0.0, "speed": 0.0})
    assert np.abs(run.outputs - own).max(axis=0) == pytest.approx(0.0, abs=1e-9)


def test_terms_stand_at_inputs_pairs_storages_and_outputs(study: Study, way: str) -> None:
    names = {c.name for c in study.subject.candidates(["voltage", "load_torque"])}
    assert {"dead_band_at_voltage", "coulomb_at_speed", "bias_at_angle", "delay", "resistance"} <= names
    assert ("leak_at_current" in names) is (way == "model_exchange")


@pytest.mark.parametrize("fault", ["crashes", pytest.param("hangs", marks=pytest.mark.thorough)])
def test_a_crash_or_a_hang_costs_one_evaluation(folder: Path, fault: str) -> None:
    fmu = build(folder / f"{fault}.fmu", "dc_motor", ways=("model_exchange",), fault=fault)
    subject = read_study(write_study(folder, fmu, [folder / "e1.csv"], noise=NOISE)).subject
    problem = build_problem(subject, [log_of_fmu(folder / "e1.csv", fmu)], noise=NOISE)
    assert isinstance(problem.kernel, RemoteLibraryKernel)
    problem.kernel.limits = problem.kernel.limits.model_copy(update={"load": 3.0})
    noise = problem.plain
    good = problem.score(problem.values, noise).nll
    assert problem.score({**problem.values, "resistance": 2.0 * RESISTANCE}, noise).nll == np.inf
    assert problem.score(problem.values, noise).nll == good
    assert len(problem.kernel.failures) == 1
    assert len([*failure_warnings(problem)]) == 1


@pytest.mark.thorough
def test_a_candidate_with_which_the_fmu_hangs_costs_that_candidate_only(folder: Path, tmp_path: Path) -> None:
    """It hangs while its resistance is 5 % above the start value, which one candidate tries."""
    fmu = build(tmp_path / "hangs.fmu", "dc_motor", ways=("model_exchange",), fault="hangs")
    logs = [Path(shutil.copy(folder / f"dry_{n}.csv", tmp_path)) for n in ("e1", "e2")]
    names = ["coulomb_at_speed", "resistance", "quadratic_drag_at_speed"]
    path = write_study(
        tmp_path, fmu, logs, noise=NOISE, candidates=names, limits={"step": "1 s"}, tolerance={"resistance": 0.5}
    )
    record = cosim.refine(path, tmp_path / "out").record
    assert [e["name"] for e in record["effects"]] == ["coulomb_at_speed"]
    (said,) = [w for w in record["warnings"] if "which count as diverged" in w]
    assert "takes longer than" in said
    fitted = {n for c in record["candidates"] if c["fitted"] for n in c["names"]}
    assert {"coulomb_at_speed", "quadratic_drag_at_speed"} <= fitted


def test_names_of_the_fmu_are_those_of_study_and_log(tmp_path: Path) -> None:
    fmu = build(tmp_path / "drive.fmu", "drive")
    time = 0.01 * np.arange(600)
    torque = np.sign(np.sin(3.0 * time))
    with Drive(
        log_of_fmu(write_log(tmp_path / "raw.csv", {"time": time, "torque": torque, "motor.phi": time}), fmu), fmu
    ) as drive:
        outputs = dict(zip(drive.outputs, drive.run(0, 599, {}).T, strict=True))
    rng = np.random.default_rng(0)
    readings: Mapping[str, Any] = {n: y + 1e-3 * rng.standard_normal(600) for n, y in outputs.items()}
    logs = [write_log(tmp_path / "e1.csv", {"time": time, "torque": torque, **readings})]
    study = read_study(write_study(tmp_path, fmu, logs, tolerance={"motor.J": 0.1}, noise={"motor.phi": 1e-3}))
    assert study.content.tolerance == {"motor_J": 0.1}
    assert set(study.logs[0].outputs) == {with_underscore.replace(".", "_") for with_underscore in outputs}


def test_faults_of_a_study_of_an_fmu(folder: Path) -> None:
    fmu = build(folder / "model_exchange2.fmu", "dc_motor")
    with pytest.raises(InputError) as raised:
        read_study(write_study(folder, fmu, [folder / "none.csv"], [folder / "no.csv"], terms="nothing.py"))
    text = str(raised.value)
    assert "none.csv" in text
    assert "no.csv" in text
    assert "nothing.py" in text
    with pytest.raises(InputError, match="no base parameter"):
        read_study(write_study(folder, fmu, [folder / "e1.csv"], tolerance={"resistence": 0.1}))
    with pytest.raises(InputError, match="no such file"):
        read_study(write_study(folder, folder / "motor.fmu", [folder / "e1.csv"]))
    with pytest.raises(InputError, match="per_log"):
        build_problem_of_per_log(folder, fmu)
    with pytest.raises(InputError) as removed:
        read_study(write_study(folder, fmu, [folder / "e1.csv"], delivery="ssp"))
    assert [fault.line for fault in removed.value.faults] == [1]


def test_a_study_of_an_fmu_without_a_c_compiler_is_refused_before_the_work(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fmu = build(folder / "model_exchange2.fmu", "dc_motor")
    monkeypatch.setenv("CC", "no-such-compiler")
    monkeypatch.setattr("cosim.fmi.native.compiler.can_cross", lambda: False)
    with pytest.raises(InputError, match=r"fmu-cosim\[refine\]") as refused:
        cosim.refine(write_study(folder, fmu, [folder / "e1.csv"]), folder / "refused")
    assert [fault.file for fault in refused.value.faults] == [fmu]
    assert not (folder / "refused").exists()


def test_a_replay_leaves_the_study_that_goes_on(folder: Path, tmp_path: Path) -> None:
    fmu = build(folder / "model_exchange2.fmu", "dc_motor", 2, ways=("model_exchange",))
    columns = columns_of(folder / "dry_e1.csv")
    log = write_log(tmp_path / "log.csv", {n.replace("speed", "w"): v for n, v in columns.items()})
    done = command("replay", log, "--plant", fmu, "--column", "w=speed", "--no-report", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert f"next: cosim refine {tmp_path / 'out' / 'study.yaml'}" in done.stdout
    study = read_study(tmp_path / "out" / "study.yaml")
    assert (study.content.columns, len(study.logs)) == ({"w": "speed"}, 1)
    cosim.replay(folder / "e1.csv", tmp_path / "out", fmu, report=False, force=True)  # nothing is missing
    assert not (tmp_path / "out" / "study.yaml").exists()


@pytest.mark.parametrize("kind", ["sensor", "effect"])
def test_a_replay_of_a_refined_fmu_names_the_claimed_error_of_a_sensor(folder: Path, tmp_path: Path, kind: str) -> None:
    """The FMU holds no error of a sensor; a further refine would only find it again."""
    parameters = {"factor": {"value": 1.1, "unit": "1", "ci95": [1.09, 1.11]}}
    entry = {"name": "scale_at_speed", "kind": kind, "parameters": parameters, "probability": 1.0}
    fmu = build(tmp_path / "plant.fmu", "dc_motor", 2, ways=("model_exchange",))
    (tmp_path / "refine.json").write_text(json.dumps({"effects": [entry]}))
    columns = columns_of(folder / "e1.csv")
    log = write_log(tmp_path / "log.csv", columns | {"speed": 1.1 * columns["speed"]})
    done = command("replay", log, "--plant", fmu, "--no-report", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    said = "The readings have scale_at_speed, which the refine beside plant.fmu claims and an FMU does not hold"
    assert (said in done.stdout) == (kind == "sensor")
    assert ("cosim refine" in done.stdout) == (kind == "effect")
    assert (tmp_path / "out" / "study.yaml").exists() == (kind == "effect")


def columns_of(path: Path) -> dict[str, Any]:
    """Return the columns of a log."""
    table = np.genfromtxt(path, delimiter=",", names=True)
    return {name: table[name] for name in table.dtype.names}


def build_problem_of_per_log(folder: Path, fmu: Path) -> None:
    logs = [folder / "e1.csv", folder / "e2.csv"]
    problem_of(read_study(write_study(folder, fmu, logs, per_log=["resistance"])))


@pytest.mark.thorough
def test_dry_friction_is_named_and_delivered(folder: Path, way: str, tmp_path: Path) -> None:
    fmu = build(folder / f"{way}2.fmu", "dc_motor", ways=(way,))
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


# -- experiments --------------------------------------------------------------------------------------

LIMITS = ["voltage=6", "load_torque=0.002"]
FRICTIONS = ["coulomb_at_speed", "viscous_at_speed"]


@pytest.mark.thorough
def test_excite_separates_terms_of_an_fmu_within_limits(folder: Path, way: str, tmp_path: Path) -> None:
    fmu = build(folder / f"{way}2.fmu", "dc_motor", 2, ways=(way,))
    planned = excite(str(fmu), tmp_path, FRICTIONS, limits=LIMITS, duration=6.0, experiments=4)
    assert min(planned.apart.values()) >= min(planned.usual.values())
    assert (tmp_path / "plant.fmu").read_bytes() == fmu.read_bytes()
    rows = cosim.run(tmp_path / "excitation.yaml", tmp_path / "run", report=False)
    assert np.abs(rows["plant.voltage"]).max() <= 6.0
    assert np.abs(rows["plant.speed"] - planned.trial.outputs["speed"]).max() < 0.05 * np.ptp(rows["plant.speed"])


def test_excite_goes_on_from_the_folder_that_refine_left(folder: Path, tmp_path: Path) -> None:
    fmu = build(folder / "model_exchange2.fmu", "dc_motor", 2, ways=("model_exchange",))
    study = write_study(folder, fmu, [folder / "e1.csv", folder / "e2.csv"], noise=NOISE)
    fits = [{"coulomb_at_speed.level": 0.004, "coulomb_at_speed.softness": 0.5}, {"viscous_at_speed.coefficient": 1e-4}]
    ranking = [
        {"names": [name], "parameters": fit, "fitted": True, "log_likelihood_gain": 50.0}
        for name, fit in zip(FRICTIONS, fits, strict=True)
    ]
    record = {"study": str(study), "rivals": FRICTIONS, "candidates": ranking, "hidden": [], "measured": [*NOISE]}
    (tmp_path / "refine.json").write_text(json.dumps(record))
    question = ask(str(tmp_path))
    assert question.pairs == (tuple(FRICTIONS),)
    assert question.of_fmu is not None
    assert [dict(r.values) for r in question.rivals] == fits
    assert question.ranges["voltage"][1] < 8.0  # that of the logs, since the FMU declares none
    with pytest.raises(InputError, match="how far from 0 may load_torque go"):
        ask(str(fmu), limits=["voltage=6"])
    with pytest.raises(InputError, match="no candidate"):
        ask(str(tmp_path), ["colomb_at_speed"])
