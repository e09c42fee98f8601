"""Native FMUs: the same values as the FMUs in Python, whatever is awake, and the same refusals."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu

import cosim
from controller.loop import Loop
from controller.settings import Settings
from cosim.core.errors import InputError
from cosim.fmi.building.build import build_native
from cosim.fmi.building.file import load_model
from cosim.fmi.native.compiler import compiler
from cosim.model import Model, Stepper, parameters_of
from plant.hovercraft import Hovercraft
from tests.cases import some
from tests.hosts_fmpy import Instance, description_of
from tests.native import NEEDS_COMPILER
from tests.tank import MODEL as TANK
from tests.test_effects import CASES, EVERYTHING, MEMORY, MOVING, named

GOLDEN = Path(__file__).resolve().parent / "data" / "native_plant_variables.txt"
PLANTS = Path(__file__).resolve().parent / "blind" / "plants"
STEP, TIGHT = 0.02, 1e-10  # rounding alone: what C and Python add up in another order
pytestmark = NEEDS_COMPILER
Rows = list[tuple[float, ...]]


def wandering(model: Model, rows: int, seed: int = 1, size: float = 1.0) -> Rows:
    """Commands about their start values, held for a while and wandering in between."""
    rng = np.random.default_rng(seed)
    start = np.array(model.start_command())
    span = size * np.array([model.excursion.get(q.name, 0.1 * max(1.0, abs(q.start))) for q in model.inputs])
    steps = np.repeat(rng.uniform(-0.7, 0.7, (rows // 20 + 1, start.size)), 20, axis=0)[:rows]
    walk = np.cumsum(rng.normal(size=(rows, start.size)), axis=0) / np.sqrt(rows)
    return [tuple(row) for row in (start + span * (steps + 0.3 * walk)).tolist()]


def by_python(model: Model, rows: Rows, values: dict[str, Any], step: float) -> Any:
    """What the lines of the FMU in Python give."""
    starts = {name.removesuffix("_start"): v for name, v in values.items() if name.endswith("_start")}
    given = {name: v for name, v in values.items() if not name.endswith("_start")}
    stepper = Stepper(model.with_values(given))
    moment, outputs = stepper.start(0.0, starts), []
    for row in rows:
        moment = stepper.step(moment, row, step)
        outputs.append(stepper.output(moment.t, moment.state, row))
    return np.array(outputs)


def by_fmu(fmu: Path, rows: Rows, values: dict[str, Any], step: float) -> Any:
    with Instance(fmu) as instance:
        instance.initialize(values)
        place = {name: v.valueReference for name, v in instance.variables.items()}
        inputs, outputs = ([place[n] for n in instance.names(c)] for c in ("input", "output"))
        found = []
        for k, row in enumerate(rows):
            instance.call("setReal", inputs, list(row))
            instance.call("doStep", k * step, step)
            found.append(instance.call("getReal", outputs))
    return np.array(found)


def difference(a: Any, b: Any) -> float:
    """Largest difference / max(1, largest value), over the outputs."""
    return float(np.max(np.max(np.abs(a - b), axis=0) / np.maximum(1.0, np.max(np.abs(a), axis=0))))


# -- the same values ----------------------------------------------------------------------------


STARTS = {f"{name}_start": v for name, v in (MOVING | MEMORY).items()}
FAST = {"psi_dot": 60.0, "phi_dot": 10.0, "phi": 3.0, "vx": -10.0, "vy": 10.0, "tilt_right": 3.0, "tilt_left": -3.0}
DELAYED = {"actuator_delay.time": 0.5, "servo_backlash.width": 0.05}  # a step may be any, a history grows with need
CRAFT = Hovercraft()
RUNS = [
    (named(EVERYTHING) | STARTS, wandering(CRAFT, 400), STEP),
    ({f"{name}_start": v for name, v in FAST.items()} | {"height": 0.1}, wandering(CRAFT, 300, size=4.0), STEP),
    *(
        pytest.param(named(effects) | STARTS, wandering(CRAFT, 400), STEP, marks=pytest.mark.thorough)
        for effects in ({}, *(case for case, _ in CASES))
    ),
    *(
        pytest.param(DELAYED, wandering(CRAFT, count), step, marks=pytest.mark.thorough)
        for step, count in ((0.0013, 1500), (0.1, 40))
    ),
]


@pytest.mark.parametrize(("values", "rows", "step"), RUNS)
def test_the_native_plant_is_the_one_in_python(values: Any, rows: Rows, step: float, native_plant: Path) -> None:
    exact = by_python(CRAFT, rows, values, step)
    assert difference(exact, by_fmu(native_plant, rows, values, step)) < TIGHT
    if values.items() > STARTS.items():  # and it acts
        assert difference(exact, by_fmu(native_plant, rows, STARTS, step)) > 1e-4


@pytest.mark.parametrize(
    "name", some(["tanks.py:Tanks", "quarter_car.py:QuarterCar", "drive_train.py:DriveTrain"], every=3)
)
def test_a_native_model_of_ones_own_is_the_one_in_python(name: str, tmp_path: Path) -> None:
    model = load_model(str(PLANTS / name), Path()).model
    (built,) = build_native(tmp_path, str(PLANTS / name))
    rows = wandering(model, 150)
    typical = {
        f"{kind.name}.{p.name}": min(max(p.neutral + p.typical, p.bounds[0]), p.bounds[1])
        for kind in model.catalogue
        for p in parameters_of(kind)
        if p.neutral is not None and p.typical is not None
    }
    for values in ({}, typical):
        exact = by_python(model, rows, values, model.rate)
        assert difference(exact, by_fmu(built.path, rows, values, model.rate)) < TIGHT


def test_a_refined_model_has_its_values_as_defaults(tmp_path: Path) -> None:
    (tmp_path / "tank.py").write_text(TANK, encoding="utf-8")
    (tmp_path / "model.yaml").write_text("model: tank.py:Tank\nparameters: {area: 0.3, leak.rate: 0.01}\n")
    (refined,) = build_native(tmp_path / "refined", str(tmp_path / "model.yaml"))
    (plain,) = build_native(tmp_path / "plain", f"{tmp_path}/tank.py:Tank")
    rows, values = [(0.02 + 0.01 * (k % 7),) for k in range(100)], {"area": 0.3, "leak.rate": 0.01}
    assert difference(by_fmu(plain.path, rows, values, 0.5), by_fmu(refined.path, rows, {}, 0.5)) == 0.0
    assert description_of(refined.path).guid != description_of(plain.path).guid


# -- the controller -----------------------------------------------------------------------------

SETTINGS: list[dict[str, Any]] = [
    {},
    {"estimator": "lagged", "lag": 0.005, "sample_time": 0.1},
    {"estimator": "consistent", "mass": 0.9, "friction": 1.0, "yaw_damping": 0.02, "tilt_max": 0.05},
    {"estimator": "consistent", "fix_latency": 0.08, "measurement_variance_x": 0.01},
]


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_the_native_controller_is_filterpy_and_lqr(settings: dict[str, Any], native_fmus: Path) -> None:
    rows = np.cumsum(np.random.default_rng(1).normal(size=(500, 8)) * 0.02, axis=0)
    own = Settings(**settings)
    loop = Loop(own, [0.3, 0.0, 0.1, 0.0, 0.0], 0.0, 0.0)
    exact = []
    rows[:, 7] = np.arange(500) // 5  # fixes at 10 Hz
    for psi, psi_dot, ax, x_ref, psi_ref, x_meas, _, fix in rows:
        loop.step((psi, psi_dot, ax), x_ref, psi_ref, x_meas, 0.0, fix)
        exact.append(loop.outputs())
    values = settings | {"x_hat_start": 0.3, "psi_hat_start": 0.1}
    listed = [tuple(row) for row in rows.tolist()]
    found = by_fmu(native_fmus / "controller-native.fmu", listed, values, own.sample_time)
    assert difference(np.array(exact), found) < 1e-12


@pytest.mark.parametrize(
    ("values", "step", "said"),
    [
        ({"estimator": "kalman"}, STEP, "appendix_f, lagged, consistent"),
        (
            {"mass": 99.0, "lag": 0.0},
            STEP,
            "mass is 99; allowed range: [0.05, 20] kg; lag is 0; allowed range: [0.005, 2] s",
        ),
        ({}, 0.03, "sample_time"),
    ],
)
def test_the_native_controller_refuses_what_makes_no_sense(
    values: dict[str, Any], step: float, said: str, native_fmus: Path
) -> None:
    with Instance(native_fmus / "controller-native.fmu") as instance, pytest.raises(FMICallException):
        instance.initialize(values).step(0.0, step)
    assert said in instance.log[-1]


# -- the description ----------------------------------------------------------------------------


def test_names_and_value_references_stay_as_the_golden_file_has_them(native_plant: Path, plant_fmu: Path) -> None:
    native, python = (
        {v.name: v.valueReference for v in description_of(fmu).modelVariables} for fmu in (native_plant, plant_fmu)
    )
    assert python.items() <= native.items()
    golden = dict(line.split()[::-1] for line in GOLDEN.read_text(encoding="utf-8").splitlines())
    assert {name: str(vr) for name, vr in native.items()} == golden


@pytest.mark.parametrize(("name", "ways"), [("plant-native.fmu", 2), ("controller-native.fmu", 1)])  # it samples
def test_a_native_fmu_is_valid_and_runs_without_a_tool(name: str, ways: int, native_fmus: Path) -> None:
    description = description_of(native_fmus / name)
    assert validate_fmu(str(native_fmus / name)) == []
    offered = [way for way in (description.coSimulation, description.modelExchange) if way is not None]
    assert len(offered) == ways
    assert {way.needsExecutionTool for way in offered} == {False}
    with zipfile.ZipFile(native_fmus / name) as archive:
        assert {"sources/all.c", "documentation/license.txt"} <= set(archive.namelist())
        assert archive.read("modelDescription.xml").decode().count('<File name="all.c" />') == ways


def test_two_builds_are_the_same_bytes(native_plant: Path, tmp_path: Path) -> None:
    again, _ = build_native(tmp_path, "hovercraft")
    assert again.path.read_bytes() == native_plant.read_bytes()


def test_a_package_that_is_reached_through_a_link_builds_models(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(Path(cosim.__file__).parents[1])
    words = ["build", "--native", "--model", f"{PLANTS / 'tanks.py'}:Tanks", "--out", str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "link")}
    subprocess.run([sys.executable, "-P", "-m", "cosim", *words], env=environment, check=True)
    assert validate_fmu(str(next(tmp_path.glob("*.fmu")))) == []


# -- the C --------------------------------------------------------------------------------------


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "values"), [("plant", named(EVERYTHING)), ("controller", {})])
def test_the_c_is_clean_under_warnings_and_sanitizers(
    name: str, values: dict[str, float], native_fmus: Path, tmp_path: Path
) -> None:
    fmu, driver = native_fmus / f"{name}-native.fmu", Path(__file__).resolve().parent / "native_driver.c"
    with zipfile.ZipFile(fmu) as archive:
        archive.extractall(tmp_path)
    command = [*(compiler() or ()), "-std=c99", "-O1", "-Wall", "-Wextra", "-pedantic", "-Werror", "-I."]
    for options in (["-fsanitize=address,undefined", "-fno-sanitize-recover=all"], []):  # not every compiler has them
        program = [*command, *options, str(driver), "all.c", "-o", "driver", "-lm"]
        made = subprocess.run(program, cwd=tmp_path / "sources", capture_output=True, text=True)
        if made.returncode == 0:
            break
    assert made.returncode == 0, made.stderr
    place = {v.name: v.valueReference for v in description_of(fmu).modelVariables}
    arguments = [text for n, v in values.items() for text in (str(place[n]), repr(v))]
    run = subprocess.run([str(tmp_path / "sources" / "driver"), "0.02", *arguments], capture_output=True, text=True)
    assert (run.returncode, run.stderr) == (0, ""), run.stdout + run.stderr


def test_unknown_platforms_and_versions_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="linux32") as refused:
        build_native(tmp_path / "out", "hovercraft", platforms=("linux32",))
    assert refused.value.exit_code == 2
    with pytest.raises(InputError, match="--fmi"):
        build_native(tmp_path / "out", fmi=1)
    assert not (tmp_path / "out").exists()
