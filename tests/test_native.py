"""Native FMUs: the same values as the FMUs in Python, whatever is awake, and the same refusals."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu

from controller.loop import Loop
from controller.settings import Settings
from cosim.core.errors import InputError
from cosim.fmi.building.build import build_native
from cosim.fmi.native.compiler import can_cross, compiler, glibc_floor, this_platform
from cosim.model import Model, Stepper, parameters_of
from plant.hovercraft import Hovercraft
from tests.hosts_fmpy import Instance, description_of
from tests.native import NEEDS_COMPILER, is_subnormal
from tests.tank import MODEL as TANK
from tests.test_effects import CASES, EVERYTHING, MEMORY, MOVING, named

GOLDEN = Path(__file__).resolve().parent / "data" / "native_plant_variables.txt"
PLANTS = Path(__file__).resolve().parent / "blind" / "plants"
STEP, TIGHT = 0.02, 1e-10  # rounding alone: what C and Python add up in another order
pytestmark = NEEDS_COMPILER
Rows = list[tuple[float, ...]]


def wandering(model: Model, rows: int, seed: int = 1) -> Rows:
    """Commands about their start values, held for a while and wandering in between."""
    rng = np.random.default_rng(seed)
    start = np.array(model.start_command())
    size = np.array([model.excursion.get(q.name, 0.1 * max(1.0, abs(q.start))) for q in model.inputs])
    steps = np.repeat(rng.uniform(-0.7, 0.7, (rows // 20 + 1, start.size)), 20, axis=0)[:rows]
    walk = np.cumsum(rng.normal(size=(rows, start.size)), axis=0) / np.sqrt(rows)
    return [tuple(row) for row in (start + size * (steps + 0.3 * walk)).tolist()]


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
FAST = {"psi_dot": 6.0, "phi_dot": 1.0, "phi": 0.3, "vx": 1.0, "vy": 1.0, "tilt_right": 0.3, "tilt_left": 0.3}
EFFECTS = [
    pytest.param(named(effects) | STARTS, wandering(Hovercraft(), 400), STEP, marks=pytest.mark.thorough)
    for effects in ({}, *(case for case, _ in CASES), EVERYTHING)
]


def fast(size: float) -> Any:
    """Angles that move however fast."""
    rng = np.random.default_rng(3)
    values = {f"{name}_start": size * v * rng.uniform(-1, 1) for name, v in FAST.items()}
    commands = rng.uniform((5.0, 5.0, -0.4 * size, -0.4 * size), (8.0, 8.0, 0.4 * size, 0.4 * size), (300, 4))
    more = {"height": 0.1, "ground_effect_exponent": min(0.5 + size, 5.0)}
    return values | more, [tuple(row) for row in commands.tolist()], STEP


DELAYED = {"actuator_delay.time": 0.5, "servo_backlash.width": 0.05}  # a step may be any, a history grows with need
STEPS = [
    pytest.param(DELAYED, wandering(Hovercraft(), count), step, marks=pytest.mark.thorough)
    for step, count in ((0.0013, 1500), (0.1, 40))
]


@pytest.mark.parametrize(("values", "rows", "step"), [*EFFECTS, *map(fast, (0.1, 1.0, 10.0)), *STEPS])
def test_the_native_plant_is_the_one_in_python(values: Any, rows: Rows, step: float, native_plant: Path) -> None:
    exact = by_python(Hovercraft(), rows, values, step)
    assert difference(exact, by_fmu(native_plant, rows, values, step)) < TIGHT
    if values.items() > STARTS.items():  # and it acts
        assert difference(exact, by_fmu(native_plant, rows, STARTS, step)) > 1e-4


def test_a_decay_ends_at_zero_natively_and_as_a_subnormal_number_in_python(native_plant: Path) -> None:
    rows = [Hovercraft().start_command()] * 6000  # two minutes
    values = {"phi_start": 0.2, "psi_dot_start": 1.0, "vx_start": 0.5, "friction": 4.0}
    exact, native = by_python(Hovercraft(), rows, values, STEP), by_fmu(native_plant, rows, values, STEP)
    assert is_subnormal(exact).any()
    assert not is_subnormal(native).any()
    assert difference(exact, native) < TIGHT


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["drive_train.py:DriveTrain", "tanks.py:Tanks", "quarter_car.py:QuarterCar"])
def test_a_native_model_of_ones_own_is_the_one_in_python(name: str, tmp_path: Path) -> None:
    from cosim.fmi.building.file import load_model

    model = load_model(str(PLANTS / name), Path()).model
    (built,) = build_native(tmp_path, str(PLANTS / name))
    assert built.path == tmp_path / "plant-native.fmu"
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
]


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_the_native_controller_is_filterpy_and_lqr(settings: dict[str, Any], native_fmus: Path) -> None:
    rows = np.cumsum(np.random.default_rng(1).normal(size=(500, 8)) * 0.02, axis=0)
    own = Settings(**settings)
    loop = Loop(own, [0.3, 0.0, 0.1, 0.0, 0.0], 0.0, 0.0)
    exact = []
    rows[:, 7] = np.arange(500) // 5  # fixes at 10 Hz
    for psi, psi_dot, ax, x_ref, psi_ref, x_meas, _, fix in rows:
        loop.step((psi, psi_dot, ax), x_ref, psi_ref, fix, x_meas)
        exact.append([own.duty_nominal] * 2 + [*loop.command, *loop.estimate, *loop.sigma])
    values = settings | {"x_hat_start": 0.3, "psi_hat_start": 0.1}
    listed = [tuple(row) for row in rows.tolist()]
    found = by_fmu(native_fmus / "controller-native.fmu", listed, values, own.sample_time)
    assert difference(np.array(exact), found) < 1e-12


@pytest.mark.parametrize("estimator", ["appendix_f", "consistent"])
def test_the_native_controller_uses_fixes_as_the_one_in_python(
    estimator: str, native_fmus: Path, controller_fmu: Path
) -> None:
    rng = np.random.default_rng(3)
    fixes = [(*(0.1 * rng.normal(size=7)).tolist(), k // 5 + 0.0) for k in range(200)]  # 10 Hz
    values = {"estimator": estimator, "fix_latency": 0.08, "measurement_variance_x": 0.01}
    native, python = (
        by_fmu(fmu, fixes, values, STEP) for fmu in (native_fmus / "controller-native.fmu", controller_fmu)
    )
    assert difference(python, native) < 1e-12
    assert difference(python, by_fmu(controller_fmu, [(*row[:7], 0.0) for row in fixes], values, STEP)) > 1e-2


@pytest.mark.parametrize(
    ("values", "step", "said"),
    [
        ({"estimator": "kalman"}, STEP, "estimator is kalman; it is one of appendix_f, lagged, consistent"),
        ({"mass": 99.0, "lag": 0.0}, STEP, "mass is 99; it lies in [0.05, 20] kg; lag is 0; it lies in [0.005, 2] s"),
        ({}, 0.03, "step of 0.03 s; the controller is sampled at 0.02 s (parameter sample_time)"),
    ],
)
def test_the_native_controller_refuses_as_the_one_in_python(
    values: dict[str, Any], step: float, said: str, native_fmus: Path, controller_fmu: Path
) -> None:
    for fmu in (native_fmus / "controller-native.fmu", controller_fmu):
        with Instance(fmu) as instance, pytest.raises(FMICallException):
            instance.initialize(values).step(0.0, step)
        assert said.replace("kalman", "") in instance.log[-1].replace("'", "").replace("kalman", "").replace(".0;", ";")


# -- the description ----------------------------------------------------------------------------


def test_names_and_value_references_stay_as_the_golden_file_has_them(native_plant: Path, plant_fmu: Path) -> None:
    native, python = (
        {v.name: v.valueReference for v in description_of(fmu).modelVariables} for fmu in (native_plant, plant_fmu)
    )
    assert python.items() <= native.items()
    golden = dict(line.split()[::-1] for line in GOLDEN.read_text(encoding="utf-8").splitlines())
    assert {name: str(vr) for name, vr in native.items()} == golden


@pytest.mark.parametrize("name", ["plant-native.fmu", "controller-native.fmu"])
def test_a_native_fmu_is_valid_and_runs_without_a_tool(name: str, native_fmus: Path) -> None:
    description = description_of(native_fmus / name)
    assert validate_fmu(str(native_fmus / name)) == []
    ways = [way for way in (description.coSimulation, description.modelExchange) if way is not None]
    assert len(ways) == (2 if "plant" in name else 1)  # the controller samples
    assert description.modelName == ("HovercraftPlant" if "plant" in name else "HovercraftController")
    assert {way.modelIdentifier for way in ways} == {f"{description.modelName}Native"}
    assert {way.needsExecutionTool for way in ways} == {False}
    with zipfile.ZipFile(native_fmus / name) as archive:
        listed = set(archive.namelist())
        assert {"sources/all.c", "sources/model.c", "sources/fmi2.c", "documentation/license.txt"} <= listed
        assert archive.read("modelDescription.xml").decode().count('<File name="all.c" />') == len(ways)
        assert "2-Clause BSD" in archive.read("sources/fmi2Functions.h").decode()
        page = archive.read("documentation/index.html").decode()
    machine = this_platform()
    assert machine is not None
    assert f"Libraries for {machine.name}; none for" in page
    assert description.guid in page


def test_two_builds_are_the_same_bytes(native_plant: Path, tmp_path: Path) -> None:
    again, _ = build_native(tmp_path, "hovercraft")
    assert again.path.read_bytes() == native_plant.read_bytes()


def test_nothing_but_fmi_is_seen_from_outside(native_plant: Path, tmp_path: Path) -> None:
    if not (sys.platform == "linux" and shutil.which("nm")):
        pytest.skip("no nm")
    with zipfile.ZipFile(native_plant) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith(".so"))
        library = Path(archive.extract(name, tmp_path))
    command = ["nm", "--dynamic", "--defined-only", str(library)]
    symbols = {line.split()[-1] for line in subprocess.check_output(command, text=True).splitlines()}
    assert {"fmi2DoStep", "fmi2GetDerivatives"} <= symbols
    assert all(symbol.startswith("fmi2") for symbol in symbols)
    assert glibc_floor(library.read_bytes()).startswith("2.")


def test_a_value_reference_of_nothing_is_refused(native_plant: Path) -> None:
    with Instance(native_plant).initialize() as instance, pytest.raises(FMICallException):
        instance.call("getReal", [9999])
    assert "no Real with value reference 9999" in instance.log[-1]


def test_what_follows_from_parameters_follows_until_it_is_set(native_plant: Path) -> None:
    with Instance(native_plant) as instance:
        instance.begin({"duty_nominal": 6.6})
        assert instance.get(["duty_right"]) == [6.6]
        thrust = instance.get(["thrust_right"])[0]
        instance.set({"thrust_right_start": 1.0, "duty_right": 6.0})
        assert instance.get(["duty_right", "duty_left"]) == [6.0, 6.6]
        assert instance.get(["thrust_right"])[0] < 0.5 * thrust


# -- the C --------------------------------------------------------------------------------------


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["plant", "controller"])
def test_the_c_is_clean_under_warnings_and_sanitizers(name: str, native_fmus: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(native_fmus / f"{name}-native.fmu") as archive:
        archive.extractall(tmp_path)
    sources, driver = tmp_path / "sources", Path(__file__).resolve().parent / "native_driver.c"
    command = [*(compiler() or ()), "-std=c99", "-O1", "-Wall", "-Wextra", "-pedantic", "-Werror"]
    sanitized = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    empty = tmp_path / "empty.c"
    empty.write_text("int main(void) { return 0; }\n")
    if subprocess.run(
        [*command, *sanitized, str(empty), "-o", str(tmp_path / "empty")], capture_output=True
    ).returncode:
        sanitized = []  # a compiler without them still warns
    program = [*command, *sanitized, "-I.", str(driver), "all.c", "-o", "driver", "-lm"]
    made = subprocess.run(program, cwd=sources, capture_output=True, text=True)
    assert made.returncode == 0, made.stderr
    awake: dict[str, float] = {} if name == "controller" else named(EVERYTHING)
    place = {v.name: v.valueReference for v in description_of(native_fmus / f"{name}-native.fmu").modelVariables}
    arguments = [text for n, v in awake.items() for text in (str(place[n]), repr(v))]
    run = subprocess.run([str(sources / "driver"), "0.02", *arguments], capture_output=True, text=True)
    assert (run.returncode, run.stderr) == (0, ""), run.stdout + run.stderr


# -- bad input ----------------------------------------------------------------------------------


def test_without_a_compiler_the_cure_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if can_cross():
        pytest.skip("the extra native brings a compiler")
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(InputError, match="no C compiler is found in CC or on PATH; install gcc or clang"):
        build_native(tmp_path / "out", "hovercraft")
    assert not (tmp_path / "out").exists()


def test_an_effect_without_a_value_where_it_sleeps_is_refused_at_its_line(tmp_path: Path) -> None:
    text = TANK.replace("return self.rate * level", "return level / self.rate")
    (tmp_path / "tank.py").write_text(text, encoding="utf-8")
    place = text[: text.rindex("    def loss", 0, text.index("return level / self.rate"))].count("\n")
    with pytest.raises(InputError) as error:
        build_native(tmp_path / "out", f"{tmp_path}/tank.py:Tank")
    assert str(error.value).startswith(
        f"{tmp_path}/tank.py:{place + 1}:5: cannot be printed as C: leak has no value where"
    )
    assert "rate is 0" in str(error.value)


# -- hosts --------------------------------------------------------------------------------------


def test_unknown_platforms_and_versions_are_refused(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "cosim", "build", "-o", str(tmp_path), "--native"]
    done = subprocess.run([*command, "--platforms", "linux32,win64"], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert "linux32" in done.stderr
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match="--fmi: is 1; it is 2 or 3"):
        build_native(tmp_path, fmi=1)
