"""The loop closes: logs of a craft with something undeclared in it go in, the missing effect and a better FMU come out.

The logs are those of the blind suite's own craft (`tests.blind`), which shares no code with the model; short ones, and
few candidates, so that the suite stays quick.
"""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cosim.core.errors import InputError
from cosim.estimation.kernel.kernel import DISTURBANCE
from cosim.estimation.posing import build_problem
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.fmi.building.file import read_model
from cosim.fmi.description import read_description
from cosim.fmi.fmu_build import build
from cosim.logs.log import read_log
from cosim.model import Stepper
from cosim.refinement.refinement import Refinement
from cosim.refinement.study import read_study
from cosim.verbs.checks import check as check_files
from fmus.recipes import plant_recipe
from plant.hovercraft import Hovercraft
from tests.native import NEEDS_COMPILER
from tests.studies import FEW, holds, named, proven, refined, study_of

pytestmark = pytest.mark.optimized


@pytest.fixture(scope="module")
def rubbing(tmp_path_factory: pytest.TempPathFactory) -> Refinement:
    """A study with dry friction in it, refined once for the tests that look at it, where another one was before."""
    folder = tmp_path_factory.mktemp("rubbing")
    (folder / "out").mkdir()
    for name in ("nearest.yaml", "nearest.fmu"):
        (folder / "out" / name).write_text("earlier")
    return refined(folder, {"coulomb_friction": {"force": 0.06}})


@NEEDS_COMPILER
def test_a_missing_force_is_found_and_the_sealed_error_falls_to_the_noise(rubbing: Refinement) -> None:
    record = rubbing.record
    assert record["verdict"] == "effect_found"
    assert named(rubbing) == {"coulomb_friction"}
    assert holds(rubbing, "coulomb_friction", "force", 0.06)
    horizons, floor = {"2 s": record["error"], **record["horizons"]}, record["noise_floor"]
    for channel in ("x_world", "y_world"):
        before, after = (
            [horizons[h][variant]["validation"][channel] for h in ("0.5 s", "2 s", "free run")]
            for variant in ("before", "after")
        )
        assert before[1] > 5 * floor[channel]
        assert (after[1] ** 2 - floor[channel] ** 2) / (before[1] ** 2 - floor[channel] ** 2) < 0.05  # the excess left
        assert before == sorted(before)  # a missing force is integrated twice, longer and longer
        assert all(b > 2 * a for b, a in zip(before[1:], after[1:], strict=True))  # in 0.5 s it moves a noise of 1 mm
    way = record["replays"]  # native, and equal to those of the delivered FMU
    assert (way["through"], way["log"]) == ("native", "v1.csv"), way["why"]
    assert way["apart"] <= 1e-9


@pytest.mark.thorough
def test_a_refined_model_has_nothing_missing_and_is_left_alone(rubbing: Refinement, tmp_path: Path) -> None:
    """On the same logs; the sealed one measures less."""
    shutil.copytree(rubbing.study.path.parent, tmp_path / "study")
    spoilt(tmp_path / "study" / "v1.csv", lambda rows: rows >= 0, "x_world", "y_world")
    path = tmp_path / "study" / rubbing.study.path.name
    path.write_text(path.read_text().replace("model: base", f"model: {rubbing.folder / 'model.yaml'}"))
    r = proven(path, tmp_path / "out")
    model = read_model(rubbing.folder / "model.yaml")
    assert model.parameters["coulomb_friction.force"] == rubbing.record["effects"][0]["parameters"]["force"]["value"]
    assert (r.record["verdict"], r.record["grade"], r.record["nearest"]) == ("no_effect", "nearest", [])
    assert read_model(r.folder / "model.yaml").parameters == model.parameters


@pytest.mark.thorough
def test_an_imu_alone_tells_a_biased_gyroscope_and_leaves_the_plant_unchanged(tmp_path: Path) -> None:
    r = refined(tmp_path, {"gyro_bias": {"value": 0.03}}, position=False)
    assert (r.record["verdict"], named(r)) == ("sensor_error", {"gyro_bias"})
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
    layout, data = problem.kernel.layout, problem.logs[0]
    changes = {
        "actuator_delay.time": 0.053, "servo_backlash.width": 0.02, "servo_dead_band.width": 0.01,
        "tilt_offset.right": 0.01, "coulomb_friction.force": 0.05, "servo_rate_limit.rate": 0.8,
        "battery_sag.drop": 0.2,
        "actuator_second_order.natural_frequency": 14.0, "actuator_second_order.damping_ratio": 0.4,
        "com_offset.right": 0.004, "coriolis.gain": 1.0, "table_tilt.x": 0.003, "inflow_thrust_loss.coefficient": 0.2,
    }  # fmt: skip
    run = problem.kernel.simulate(
        data, problem.numbers({**problem.values, **changes}), problem.x0[0], np.zeros(layout.memory)
    )
    stepper = Stepper(craft.with_values(changes))
    start = dict(zip(layout.states, problem.x0[0].tolist(), strict=True))
    unknown = [name for name in start if name.startswith(DISTURBANCE)]
    assert [start.pop(name) for name in unknown] == [0.0] * len(craft.forced)
    start |= {f"actuator_delay.{q.name}": float(data.u[0, j]) for j, q in enumerate(craft.inputs)}
    moment = stepper.start(0.0, start)
    columns = [layout.states.index(q.name) for q in stepper.model.states]
    for command, state in zip(data.u[:-1].tolist(), run.states[1:, columns], strict=True):
        moment = stepper.step(moment, tuple(command), 0.02)
        assert np.allclose(state, moment.state, rtol=1e-9, atol=1e-9)


def spoilt(log: Path, keep: Callable[[np.ndarray], np.ndarray], *without: str) -> None:
    """Leave only some rows of a log, without some outputs."""
    header, *rows = csv.reader(log.read_text().splitlines())
    kept = [k for k, name in enumerate(header) if not name.startswith(without)]
    lines = [header, *(row for row, stays in zip(rows, keep(np.arange(len(rows))), strict=True) if stays)]
    log.write_text("\n".join(",".join(line[k] for k in kept) for line in lines) + "\n")


@pytest.mark.thorough
def test_a_study_that_cannot_be_judged_is_refused_at_the_start(tmp_path: Path) -> None:
    path = study_of(tmp_path, {})
    study = path.read_text()
    for name, spoil in (
        ("study.yaml", lambda: path.write_text(study.replace(FEW, "[]"))),
        ("e1.csv", lambda: spoilt(tmp_path / "e1.csv", lambda rows: rows < 245)),  # it takes 5 s
        ("v1.csv", lambda: (tmp_path / "v1.csv").write_text("time,psi\n0,1\n")),
    ):
        path.write_text(study)
        spoil()
        for check in (lambda: read_study(path), lambda: check_files([path])):
            with pytest.raises(InputError) as caught:
                check()
            assert name in {fault.file.name for fault in caught.value.faults if fault.file}
