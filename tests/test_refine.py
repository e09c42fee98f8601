"""The loop closes: logs of a craft with something undeclared in it go in, the missing effect and a better FMU come out.

The logs are those of the blind suite's own craft (`tests.blind`), which shares no code with the model; short ones, and
few candidates, so that the suite stays quick.
"""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import jsonschema
import numpy as np
import pytest

from cosim.core.errors import InputError
from cosim.estimation.kernel.kernel import DISTURBANCE, MEMORY
from cosim.estimation.posing import build_problem
from cosim.estimation.subject.model_subject import ModelSubject, neutral_values
from cosim.fmi.building.file import load_model, read_model
from cosim.fmi.description import read_description
from cosim.fmi.fmu_build import build
from cosim.logs.log import read_log
from cosim.model import Stepper
from cosim.refinement import workflow
from cosim.refinement.decision.posterior import Verdict
from cosim.refinement.refinement import Refinement
from cosim.refinement.study import read_study
from cosim.refinement.workflow import refine
from cosim.verbs.checks import check as check_files
from cosim.verbs.checks import schema_of
from fmus.recipes import plant_recipe
from plant.hovercraft import Hovercraft
from tests.native import NEEDS_COMPILER
from tests.studies import FEW, holds, named, proven, refined, study_of
from tests.tank import tank_study

pytestmark = pytest.mark.optimized


@pytest.fixture(scope="module")
def rubbing(tmp_path_factory: pytest.TempPathFactory) -> Refinement:
    """A study with dry friction in it, refined once for the tests that look at it, where another one was before."""
    folder = tmp_path_factory.mktemp("rubbing")
    (folder / "out").mkdir()
    for name in ("nearest.yaml", "nearest.fmu"):
        (folder / "out" / name).write_text("earlier")
    return refined(folder, {"coulomb_friction": {"force": 0.06}})


def test_a_missing_force_is_found_and_the_sealed_error_falls_to_the_noise(rubbing: Refinement) -> None:
    r = rubbing
    assert r.record["verdict"] == "effect_found"
    assert named(r) == {"coulomb_friction"}
    assert holds(r, "coulomb_friction", "force", 0.06)
    error, floor = r.record["error"], r.record["noise_floor"]
    for channel in ("x_world", "y_world"):
        before, after = (error[name]["validation"][channel] for name in ("before", "after"))
        assert before > 5 * floor[channel]
        assert (after**2 - floor[channel] ** 2) / (before**2 - floor[channel] ** 2) < 0.05  # the excess left
    written = json.loads((r.folder / "refine.json").read_text())
    assert written["effects"] == r.record["effects"]


def test_the_error_is_told_over_other_horizons_too(rubbing: Refinement) -> None:
    horizons = {"2 s": rubbing.record["error"], **rubbing.record["horizons"]}
    for channel in ("x_world", "y_world"):
        before, after = (
            [horizons[h][variant]["validation"][channel] for h in ("0.5 s", "2 s", "free run")]
            for variant in ("before", "after")
        )
        assert before == sorted(before)  # a missing force is integrated twice, longer and longer
        assert all(b > 2 * a for b, a in zip(before[1:], after[1:], strict=True))  # in 0.5 s it moves a noise of 1 mm


@NEEDS_COMPILER
def test_replays_are_native_and_equal_those_of_the_delivered_fmu(rubbing: Refinement) -> None:
    way = rubbing.record["replays"]
    assert way["through"] == "native", way["why"]
    assert way["log"] == "v1.csv"
    assert way["apart"] <= 1e-9


def test_the_schema_has_every_verdict() -> None:
    jsonschema.Draft202012Validator.check_schema(schema_of("refine_result"))
    assert schema_of("refine_result")["properties"]["verdict"]["enum"] == list(get_args(Verdict))


@pytest.fixture(scope="module")
def complete(rubbing: Refinement, tmp_path_factory: pytest.TempPathFactory) -> Refinement:
    """The refined model on the same logs, which lack nothing that it has not; the sealed one measures less."""
    folder = tmp_path_factory.mktemp("complete")
    shutil.copytree(rubbing.study.path.parent, folder / "study")
    without(folder / "study" / "v1.csv", "x_world", "y_world")
    path = folder / "study" / rubbing.study.path.name
    path.write_text(path.read_text().replace("model: base", f"model: {rubbing.folder / 'model.yaml'}"))
    return proven(path, folder / "out")


@pytest.mark.thorough
def test_a_refined_model_has_nothing_missing_and_is_left_alone(rubbing: Refinement, complete: Refinement) -> None:
    first, r = rubbing, complete
    model = read_model(first.folder / "model.yaml")
    assert model.parameters["coulomb_friction.force"] == first.record["effects"][0]["parameters"]["force"]["value"]
    assert r.record["verdict"] == "no_effect"
    assert r.record["effects"] == []
    assert (r.record["grade"], r.record["nearest"]) == ("nearest", [])
    assert read_model(r.folder / "model.yaml").parameters == model.parameters


@pytest.mark.thorough
def test_a_study_that_claims_nothing_writes_the_nearest_model_beside(complete: Refinement) -> None:
    written = ["model.yaml", "nearest.fmu", "nearest.yaml", "plant.fmu", "refine.json"]
    assert sorted(p.name for p in complete.folder.iterdir()) == written


@pytest.mark.thorough
def test_an_imu_alone_tells_a_biased_gyroscope_and_leaves_the_plant_unchanged(tmp_path: Path) -> None:
    r = refined(tmp_path, {"gyro_bias": {"value": 0.03}}, position=False)
    assert r.record["verdict"] == "sensor_error"
    assert named(r) == {"gyro_bias"}
    assert holds(r, "gyro_bias", "value", 0.03)
    model = read_model(tmp_path / "out" / "model.yaml")
    assert model.sensors["gyro_bias.value"] == pytest.approx(0.03, abs=5e-3)
    assert model.parameters == {}
    built = [
        read_description(f) for f in (tmp_path / "out" / "plant.fmu", build(plant_recipe(), tmp_path / "base.fmu"))
    ]
    starts = [{v.name: v.start for v in description.modelVariables} for description in built]
    assert starts[0] == starts[1]
    assert r.record["error"]["after"]["validation"]["psi_dot"] < r.record["error"]["before"]["validation"]["psi_dot"]


def without(path: Path, *outputs: str) -> None:
    """Take outputs out of a log, so that it measures less than the others."""
    with path.open() as stream:
        rows = list(csv.DictReader(stream))
    kept = [name for name in rows[0] if not name.startswith(outputs)]
    with path.open("w") as stream:
        writer = csv.DictWriter(stream, kept, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)


@pytest.mark.thorough
@pytest.mark.xfail(strict=True, reason="dry friction is claimed of a craft that stands still")
def test_logs_that_excite_nothing_are_said_to(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    sigma = [np.sqrt(Hovercraft.sensor_variance[name]) for name in ("psi", "psi_dot", "ax", "x_world", "y_world")]
    for log in "ab":
        still = np.column_stack([0.02 * np.arange(600), np.full((600, 2), 6.38763), np.zeros((600, 2))])
        header = "time,duty_right,duty_left,tilt_right,tilt_left,psi,psi_dot,ax,x_world,y_world"
        rows = np.column_stack([still, rng.normal(0.0, sigma, (600, 5))])
        np.savetxt(tmp_path / f"{log}.csv", rows, delimiter=",", header=header, comments="")
    study = tmp_path / "study.yaml"
    study.write_text("model: base\nlogs: {estimation: [a.csv], validation: [b.csv]}\n")
    r = proven(study, tmp_path / "out")
    assert (r.record["verdict"], r.record["grade"], r.record["effects"]) == ("ambiguous", "nearest", [])
    assert len(r.record["rivals"]) > 1
    assert r.record["experiment"]


def test_the_kernel_runs_the_same_equations_as_the_fmu(tmp_path: Path) -> None:
    # generated C and Python differ by rounding alone: 12 s of closed loop, integrators included
    path = study_of(tmp_path, {})
    craft = Hovercraft()
    log = read_log(path.parent / "e1.csv", craft.inputs, craft.outputs)
    problem = build_problem(ModelSubject.of(craft), [log])
    generated, data = problem.kernel.layout, problem.logs[0]
    values = neutral_values(craft) | {
        "actuator_delay.time": 0.053, "servo_backlash.width": 0.02, "servo_dead_band.width": 0.01,
        "tilt_offset.right": 0.01, "coulomb_friction.force": 0.05, "servo_rate_limit.rate": 0.8,
        "battery_sag.drop": 0.2,
        "actuator_second_order.natural_frequency": 14.0, "actuator_second_order.damping_ratio": 0.4,
        "com_offset.right": 0.004, "coriolis.gain": 1.0, "table_tilt.x": 0.003, "inflow_thrust_loss.coefficient": 0.2,
    }  # fmt: skip
    lasting = {MEMORY: 0.15}
    p = np.array([(values | lasting)[name] for name in generated.parameters])
    run = problem.kernel.simulate(data, p, problem.x0[0], np.zeros(generated.memory))
    sensors = {k.name for k in craft.sensors}
    stepper = Stepper(craft.with_values({n: v for n, v in values.items() if n.split(".")[0] not in sensors}))
    start = dict(zip(generated.states, problem.x0[0].tolist(), strict=True))
    unknown = [name for name in start if name.startswith(DISTURBANCE)]
    assert [start.pop(name) for name in unknown] == [0.0] * len(craft.forced)
    start |= {f"actuator_delay.{q.name}": float(data.u[0, j]) for j, q in enumerate(craft.inputs)}
    moment = stepper.start(0.0, start)
    columns = [generated.states.index(q.name) for q in stepper.model.states]
    for k in range(1, len(data.u)):
        moment = stepper.step(moment, tuple(data.u[k - 1].tolist()), 0.02)
        assert np.allclose(run.states[k, columns], moment.state, rtol=1e-9, atol=1e-9)


def thinned(folder: Path, keep: Callable[[np.ndarray], np.ndarray], logs: str = "*.csv") -> None:
    """Leave only some rows of logs of a study."""
    for log in folder.glob(logs):
        header, *rows = log.read_text().splitlines()
        kept = [row for row, stays in zip(rows, keep(np.arange(len(rows))), strict=True) if stays]
        log.write_text("\n".join([header, *kept]) + "\n")


def dropped(rows: np.ndarray) -> np.ndarray:
    return (np.random.default_rng(5).random(rows.size) > 0.05) | (rows == 0)


def paused(rows: np.ndarray) -> np.ndarray:
    return (rows < 270) | (rows >= 320)


@pytest.fixture(scope="module")
def patchy(tmp_path_factory: pytest.TempPathFactory) -> Refinement:
    """The same craft, its recorder worse: rows lost here and there, a pause, and in each log another set of sensors."""
    folder = tmp_path_factory.mktemp("patchy")
    path = study_of(folder / "study", {"coulomb_friction": {"force": 0.06}})
    thinned(path.parent, dropped, "[ev]1.csv")
    thinned(path.parent, paused, "e2.csv")
    without(path.with_name("e2.csv"), "ax")
    without(path.with_name("v1.csv"), "psi_dot")
    return proven(path, folder / "out")


@pytest.mark.thorough
def test_rows_that_are_missing_change_no_verdict(rubbing: Refinement, patchy: Refinement) -> None:
    r = patchy
    assert named(r) == named(rubbing) == {"coulomb_friction"}
    assert holds(r, "coulomb_friction", "force", 0.06)
    assert sum("missing in" in text for text in r.study.warnings) == 3  # of each log
    before, after = (r.record["error"][name]["validation"] for name in ("before", "after"))
    assert all(after[name] < 0.1 * before[name] for name in ("x_world", "y_world"))
    assert sorted(p.name for p in r.folder.iterdir()) == ["model.yaml", "plant.fmu", "refine.json"]


def test_a_sensor_that_starts_late_tells_nothing_of_the_start(tmp_path: Path) -> None:
    path = study_of(tmp_path, {})
    craft = Hovercraft()
    whole = read_log(path.with_name("e1.csv"), craft.inputs, craft.outputs)
    late = {name: np.where(np.arange(whole.rows) < 75, np.nan, whole.outputs[name] + 3.0) for name in ("x_world",)}
    problem = build_problem(ModelSubject.of(craft), [replace(whole, outputs=dict(whole.outputs) | late)])
    place = problem.kernel.layout.states.index("x_world")
    assert problem.x0[0][place] == 0.0
    assert problem.P0[0, 0] == 1.0
    run = problem.run(problem.values, problem.plain, 0, states=True)
    assert np.abs(run.states[75:, place] - late["x_world"][75:]).max() < 0.02  # from its first measurement on


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda f: (f / "e2.csv").write_bytes((f / "e1.csv").read_bytes()), "holds the same as e1.csv"),
        (lambda f: (f / "v1.csv").write_bytes((f / "e1.csv").read_bytes()), "a validation log is never fitted on"),
        (
            lambda f: in_study(f, "e2.csv", "./e1.csv"),
            "holds the same as e1.csv, which is listed for estimation; keep one",
        ),
        (lambda f: in_study(f, "v1.csv", "../study/e1.csv"), "which is listed for estimation; a validation log"),
        (lambda f: in_study(f, FEW, "[]"), "leave the key out to try all"),
        (lambda f: thinned(f, lambda rows: rows < 245), "too short to be judged: it takes 5 s"),
        (lambda f: (f / "v1.csv").write_text("time,psi\n0,1\n"), 'input "duty_right" is missing'),
    ],
)
def test_a_study_that_cannot_be_judged_is_refused_at_the_start(
    tmp_path: Path, spoil: Callable[[Path], object], words: str
) -> None:
    path = study_of(tmp_path / "study", {})
    spoil(path.parent)
    for check in (lambda: read_study(path), lambda: check_files([path])):
        with pytest.raises(InputError) as caught:
            check()
        assert any(words in str(f) for f in caught.value.faults), caught.value


def in_study(folder: Path, old: str, new: str) -> None:
    study = folder / "study.yaml"
    study.write_text(study.read_text().replace(old, new))


@pytest.mark.thorough
def test_an_earlier_result_outlives_a_refine_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "study").mkdir()
    path, out = tank_study(tmp_path / "study"), tmp_path / "out"
    out.mkdir()
    files = ("model.yaml", "plant.fmu", "nearest.yaml", "nearest.fmu", "refine.json", "report.html")
    for name in files:
        (out / name).write_text("earlier")

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(workflow, "noise_floor", interrupted)
    with pytest.raises(KeyboardInterrupt):
        refine(path, out)
    assert {p.name: p.read_text() for p in out.iterdir()} == dict.fromkeys(files, "earlier")


RIG = '''
from dataclasses import dataclass
from cosim.model import Delay, Equations, Model, Quantity, parameter

@dataclass(frozen=True, kw_only=True)
class Late(Delay):
    """The amplifier is late."""
    name = "late_amplifier"
    memory = (Quantity("torque", "N.m", "torque that acts until the delay has passed"),)

@dataclass(frozen=True, kw_only=True)
class Rig(Model):
    """A table on a spring, with a load cell between motor and table."""
    title = "Rig"
    base_states = (Quantity("angle", "rad", "angle"), Quantity("rate", "rad/s", "rate"))
    inputs = (Quantity("torque", "N.m", "torque commanded"),)
    outputs = (*base_states, Quantity("pull", "N.m", "what the load cell reads"))
    catalogue = (Late,)
    sensor_variance = {"angle": 1e-6, "rate": 1e-4, "pull": 1e-6}
    forced, calibrated = ("rate",), ("inertia",)
    inertia: float = parameter(0.02, unit="kg.m2", bounds=(1e-3, 1), doc="moment of inertia")
    stiffness: float = parameter(0.5, unit="N.m/rad", bounds=(0, 50), doc="spring")

    def equations(self, m):
        def derivative(t, state, command):
            return state[1], (command[0] - self.stiffness * state[0] - 0.02 * state[1]) / self.inertia
        def output(t, state, command):
            return (*state, command[0] - self.stiffness * state[0])
        return Equations(derivative, output)
'''


@pytest.mark.thorough
def test_replays_know_what_a_delay_holds_back_and_outputs_what_is_commanded(tmp_path: Path) -> None:
    (tmp_path / "rig.py").write_text(RIG)
    stepper = Stepper(load_model("rig.py:Rig", tmp_path).model.with_values({"late_amplifier.time": 0.13}))
    noise = np.array([1e-3, 1e-2, 1e-3])
    for seed, name in enumerate("abc"):
        rng = np.random.default_rng(seed)
        torque = 0.2 * np.repeat(rng.standard_normal(200), 3)
        moment, held, rows = stepper.start(), torque[0], []
        for k, u in enumerate(torque.tolist()):
            read = np.array(stepper.output(moment.t, moment.state, (held,))) + noise * rng.standard_normal(3)
            rows.append([0.02 * k, u, *read])
            moment, held = stepper.step(moment, (u,), 0.02), u
        header = "time,torque,angle,rate,pull"
        np.savetxt(tmp_path / f"{name}.csv", rows, delimiter=",", header=header, comments="")
    study = tmp_path / "study.yaml"
    study.write_text("model: rig.py:Rig\nlogs: {estimation: [a.csv, b.csv], validation: [c.csv]}\n")
    r = proven(study, tmp_path / "out")
    assert named(r) == {"late_amplifier"}
    after, floor = r.record["error"]["after"]["validation"], r.record["noise_floor"]
    assert all(after[name] < 1.1 * floor[name] for name in ("angle", "rate", "pull")), (after, floor)
