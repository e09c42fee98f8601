"""Wrapped FMUs: names, state, instances, refusals, and files of the original."""

from __future__ import annotations

import importlib
import re
import time
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException

from cosim.fmi.native import compiler
from cosim.fmi.native.compiler import NoCompiler
from cosim.fmi.native.platforms import PLATFORMS
from cosim.wrapping.wrap import CannotWrap, wrap
from tests.hosts_fmpy import Instance
from tests.native import NEEDS_COMPILER, Exchange
from tests.slider import slider_fmu
from tests.typed import typed_fmu
from tests.wrapped import EXCHANGE, STEP, STEPS, WAYS, drive_fmu, function, off, push, simulated, states_of, terms_of

pytestmark = NEEDS_COMPILER
VERSIONS = pytest.mark.parametrize("fmi", [2, 3])
LAG = {"lag_at_force.time": 0.05}


def wrapped_drive(folder: Path, kind: str, values: dict[str, float], fmi: int = 2, **options: Any) -> Path:
    path = folder / f"{kind}.fmu"
    wrap(drive_fmu(fmi), terms_of(kind, states_of("drive")), values, path, **{"substep": 1e-3, **options})
    return path


def signature(v: Any) -> tuple[Any, ...]:
    return v.name, v.valueReference, v.type, v.causality, v.variability, v.initial, v.start, v.unit, v.description


@VERSIONS
def test_variables_are_those_of_the_original_and_the_parameters(fmi: int, tmp_path: Path) -> None:
    path = wrapped_drive(tmp_path, "coulomb", {"coulomb_at_velocity.level": 7.5}, fmi)
    assert fmpy.validation.validate_fmu(str(path)) == []
    one, two = (fmpy.read_model_description(str(p)) for p in (drive_fmu(fmi), path))
    before, after = one.modelVariables, two.modelVariables
    assert [signature(v) for v in after[: len(before)]] == [signature(v) for v in before]
    (added,) = after[len(before) :]
    assert added.valueReference > max(v.valueReference for v in before)
    assert (added.name, added.start, added.unit) == ("coulomb_at_velocity.level", "7.5", "N")
    assert (added.causality, added.variability, added.initial) == ("parameter", "fixed", "exact")
    assert [s.name for s in (u.variable for u in two.derivatives)] == [
        s.name for s in (u.variable for u in one.derivatives)
    ]
    assert all(u.dependencies is None for u in two.derivatives)
    assert one.author == two.author
    assert one.license == two.license
    assert one.generationTool == two.generationTool
    for flag in ("canGetAndSetFMUstate", "canSerializeFMUstate", "canHandleVariableCommunicationStepSize"):
        assert getattr(one.coSimulation, flag, None) == getattr(two.coSimulation, flag, None)
    assert (one.guid or one.instantiationToken) != (two.guid or two.instantiationToken)


@VERSIONS
def test_the_original_is_inside_with_all_its_bytes(fmi: int, tmp_path: Path) -> None:
    path = wrapped_drive(tmp_path, "bias", {}, fmi)
    with zipfile.ZipFile(drive_fmu(fmi)) as old, zipfile.ZipFile(path) as new:
        for name in old.namelist():
            assert new.read(f"resources/original/{name}") == old.read(name)
            if name.startswith("documentation/"):
                assert new.read(name) == old.read(name)
        assert not [name for name in new.namelist() if name.startswith("sources/")]


def test_it_is_the_same_file_again(tmp_path: Path) -> None:
    paths = [wrapped_drive(tmp_path / folder, "bias", {"bias_at_force.offset": 1.0}) for folder in ("a", "b")]
    assert paths[0].read_bytes() == paths[1].read_bytes()


@pytest.mark.parametrize("kind", ["lag", "delay", "coulomb"])
def test_a_saved_state_holds_the_memory(kind: str, tmp_path: Path) -> None:
    values = {"lag": LAG, "delay": {"delay.time": 0.043}, "coulomb": {"coulomb_at_velocity.level": 5.0}}[kind]
    path = wrapped_drive(tmp_path, kind, values, substep=STEP)
    forces = 50.0 * np.random.default_rng(1).standard_normal(40)
    with Instance(path) as plant:
        plant.initialize()
        for k in range(20):
            plant.step(k * STEP, STEP, {"force": forces[k]})
        state = plant.call("getFMUstate")
        data = plant.serialized()
        first = [plant.step(k * STEP, STEP, {"force": forces[k]}) for k in range(20, 40)]
        plant.call("setFMUstate", state)
        assert [plant.step(k * STEP, STEP, {"force": forces[k]}) for k in range(20, 40)] == first
        plant.call("freeFMUstate", state)
        plant.restore(data)
        assert [plant.step(k * STEP, STEP, {"force": forces[k]}) for k in range(20, 40)] == first
    with Instance(path) as other:  # in another instance
        other.initialize()
        other.restore(data)
        assert [other.step(k * STEP, STEP, {"force": forces[k]}) for k in range(20, 40)] == first
        with pytest.raises(FMICallException):
            other.fmu.deSerializeFMUstate(b"x" * len(data))
        assert "of another FMU" in other.log[-1]


@pytest.mark.thorough
def test_a_saved_state_of_fmi_3(tmp_path: Path) -> None:
    path = wrapped_drive(tmp_path, "lag", LAG, 3, substep=STEP)
    description = fmpy.read_model_description(str(path))
    fmu = fmpy.instantiate_fmu(fmpy.extract(str(path)), description, STEPS)
    force, velocity = (
        next(v.valueReference for v in description.modelVariables if v.name == n) for n in ("force", "velocity")
    )
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()

    def go(first: int) -> list[float]:
        found = []
        for k in range(first, first + 10):
            fmu.setFloat64([force], [10.0 * k % 7])
            fmu.doStep(k * STEP, STEP)
            found += fmu.getFloat64([velocity])
        return found

    go(0)
    state = fmu.getFMUState()
    data = fmu.serializeFMUState(state)
    expected = go(10)
    fmu.setFMUState(state)
    assert go(10) == expected
    fmu.freeFMUState(state)
    state = fmu.deserializeFMUState(data)
    fmu.setFMUState(state)
    fmu.freeFMUState(state)
    assert go(10) == expected
    fmu.terminate()
    fmu.freeInstance()


@pytest.mark.thorough
def test_a_step_of_fixed_length_is_not_divided(tmp_path: Path) -> None:
    slider, fixed = slider_fmu(tmp_path / "slider.fmu"), tmp_path / "fixed.fmu"
    with zipfile.ZipFile(slider) as old, zipfile.ZipFile(fixed, "w") as new:
        for member in old.namelist():
            flag = b'canHandleVariableCommunicationStepSize="true"'
            new.writestr(member, old.read(member).replace(flag, b""))
    found = []
    for original, substep in ((fixed, 1e-3), (slider, None), (slider, 1e-3)):
        wrap(original, terms_of("coulomb"), {"coulomb_at_velocity.level": 0.2}, tmp_path / "w.fmu", substep=substep)
        found.append(simulated(tmp_path / "w.fmu", STEPS, push(2.0, 1.0)))
    assert off(found[0], found[1]) == 0.0
    assert off(found[0], found[2]) > 1e-4


@pytest.mark.thorough
def test_instances_have_parameters_and_memory_of_their_own_and_reset_forgets_both(tmp_path: Path) -> None:
    path = wrapped_drive(tmp_path, "lag", LAG, substep=STEP)
    alone = []
    for lag in (0.02, 0.2):
        with Instance(path) as plant:
            plant.initialize({"lag_at_force.time": lag})
            alone.append([plant.step(k * STEP, STEP, {"force": 10.0 * k % 7}) for k in range(10)])
    with Instance(path, "one") as one, Instance(path, "two") as two:
        one.initialize({"lag_at_force.time": 0.02})
        two.initialize({"lag_at_force.time": 0.2})
        pairs = [[p.step(k * STEP, STEP, {"force": 10.0 * k % 7}) for p in (one, two)] for k in range(10)]
        assert [list(rows) for rows in zip(*pairs, strict=True)] == alone
        one.call("reset")
        one.initialize()
        assert one.get(["lag_at_force.time"]) == [0.05]
        one.call("reset")
        one.initialize({"lag_at_force.time": 0.02})
        assert [one.step(k * STEP, STEP, {"force": 10.0 * k % 7}) for k in range(10)] == alone[0]


def test_values_are_read_as_they_were_set(tmp_path: Path) -> None:
    path = wrapped_drive(tmp_path, "bias", {"bias_at_force.offset": 2.0})
    with Instance(path) as plant:
        plant.begin({"bias_at_force.offset": 3.0, "force": 4.0, "mass": 50.0})
        assert plant.get(["mass", "bias_at_force.offset", "force", "velocity"]) == [50.0, 3.0, 4.0, 0.0]
        plant.call("exitInitializationMode")
        with pytest.raises(FMICallException):
            plant.set({"bias_at_force.offset": 1.0})
        assert "bias_at_force.offset is a fixed parameter" in plant.log[-1]


@pytest.mark.thorough
def test_terms_may_fall_asleep_after_inputs_are_set(tmp_path: Path) -> None:
    path, speeds = wrapped_drive(tmp_path, "coulomb", {"coulomb_at_velocity.level": 5.0}), []
    for values in (
        ({"force": 20.0}, {"coulomb_at_velocity.level": 0.0}),
        ({"coulomb_at_velocity.level": 0.0}, {"force": 20.0}),
    ):
        with Instance(path) as plant:
            plant.begin(values[0])
            assert plant.get(["force"]) == [values[0].get("force", 0.0)]
            plant.set(values[1])
            plant.call("exitInitializationMode")
            speeds.append(plant.step(0.0, 1.0)["velocity"])
    assert speeds[0] == speeds[1] > 0.08


def test_refusals_and_messages_of_the_original_arrive(tmp_path: Path) -> None:
    path = wrapped_drive(tmp_path, "coulomb", {"coulomb_at_velocity.level": 5.0})
    with Instance(path) as plant:
        plant.initialize()
        with pytest.raises(FMICallException):
            plant.call("doStep", float("nan"), STEP)
        assert "a step is positive and finite" in plant.log[-1]
    with Instance(path) as plant:
        again = type(plant.fmu)(
            guid="of another", modelIdentifier=plant.fmu.modelIdentifier, unzipDirectory=plant.fmu.unzipDirectory
        )
        with pytest.raises(Exception, match="instantiate"):
            again.instantiate(callbacks=plant._callbacks)
        assert "the GUID is of another" in plant.log[-1]


@VERSIONS
@pytest.mark.thorough
def test_functions_that_the_original_lacks_are_errors(fmi: int, tmp_path: Path) -> None:
    original = slider_fmu(tmp_path / "slider.fmu", fmi)
    name = b"fmi2SetString" if fmi == 2 else b"fmi3SetString"
    stripped = tmp_path / "stripped.fmu"
    with zipfile.ZipFile(original) as old, zipfile.ZipFile(stripped, "w") as new:
        for member in old.namelist():
            new.writestr(member, old.read(member).replace(name + b"\0", b"x" + name[1:] + b"\0"))
    wrap(stripped, terms_of("bias"), {}, tmp_path / "w.fmu")
    log: list[str] = []
    assert simulated(tmp_path / "w.fmu", STEPS, push(0.5)).shape == (51, 3)
    folder = fmpy.extract(str(tmp_path / "w.fmu"))
    description = fmpy.read_model_description(str(tmp_path / "w.fmu"), validate=False)
    fmu = fmpy.instantiate_fmu(folder, description, "CoSimulation", logger=lambda *said: log.append(str(said)))
    with pytest.raises(FMICallException):
        fmu.setString([0], ["text"])
    fmu.freeInstance()


@VERSIONS
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.thorough
def test_an_original_with_its_own_resources_and_another_library_name(fmi: int, way: str, tmp_path: Path) -> None:
    slider = slider_fmu(tmp_path / "slider.fmu", fmi, exchange=way == EXCHANGE, follow=True)
    original = tmp_path / "other.fmu"
    with zipfile.ZipFile(slider) as old, zipfile.ZipFile(original, "w") as new:
        for member in old.namelist():
            text = old.read(member)
            if (
                member == "modelDescription.xml"
            ):  # the library reads this start value from the file beside its resources
                text = re.sub(rb'(name="gain".*?start=)"2.0"', rb'\1"3.0"', text, flags=re.DOTALL)
            new.writestr(member.replace("slider.so", "librarian.so"), text)
    wrap(original, terms_of("bias"), {"bias_at_force.offset": 1.0, "mass": 2.0}, tmp_path / "w.fmu")
    force = push()
    expected = simulated(slider, way, force + [0.0, 1.0], {"gain": 3.0, "mass": 2.0})  # noqa: RUF005
    found = simulated(tmp_path / "w.fmu", way, force)
    assert off(expected, found) < 1e-9 * np.ptp(expected[:, 1:])
    variables = {v.name: v for v in fmpy.read_model_description(str(tmp_path / "w.fmu"), validate=False).modelVariables}
    assert variables["mass"].start == "2.0"


@pytest.mark.thorough
def test_directional_derivatives_are_withdrawn_only_where_terms_act(tmp_path: Path) -> None:
    quiet, acting = (
        wrapped_drive(tmp_path / "0", "coulomb", {}),
        wrapped_drive(tmp_path / "1", "coulomb", {"coulomb_at_velocity.level": 1.0}),
    )
    flags = [fmpy.read_model_description(str(p)).modelExchange.providesDirectionalDerivative for p in (quiet, acting)]
    assert flags == [True, False]
    exchange = Exchange(quiet, {})
    exchange.begin([0.0])
    slope = exchange.fmu.getDirectionalDerivative(
        [exchange.place["der(velocity_state)"]], [exchange.place["force"]], [1.0]
    )
    assert slope[0] == pytest.approx(1 / 95.0)
    exchange.finish()
    exchange = Exchange(quiet, {"coulomb_at_velocity.level": 1.0})
    exchange.begin([0.0])
    with pytest.raises(FMICallException):
        exchange.fmu.getDirectionalDerivative([exchange.place["der(velocity_state)"]], [exchange.place["force"]], [1.0])
    assert "active terms" in exchange.log[-1]
    exchange.finish()


def test_derivatives_read_by_name_have_the_added_rates(tmp_path: Path) -> None:
    path = wrapped_drive(tmp_path, "rate", {"viscous_at_velocity.coefficient": 2.0})
    exchange = Exchange(path, {"velocity_start": 0.5})
    exchange.begin([0.0])
    rate = exchange.rates(0.0, np.array([0.0, 0.5]))[1]
    assert rate == pytest.approx(-200.0 * 0.5 / 95.0 - 2.0 * 0.5)
    assert exchange.fmu.getReal([exchange.place["der(velocity_state)"]])[0] == rate
    exchange.finish()


@VERSIONS
def test_it_runs_here(fmi: int, tmp_path: Path) -> None:
    path = wrapped_drive(tmp_path, "coulomb", {"coulomb_at_velocity.level": 5.0}, fmi)
    run, speeds = importlib.import_module("cosim").simulate, []
    for level in (0.0, 5.0):
        start = {"force": 20.0, "coulomb_at_velocity.level": level}
        results = run(path, tmp_path / f"{level}", start, stop=1.0, step=0.01, report=False).results
        (column,) = (c for c in results.columns if c.endswith(".velocity"))
        speeds.append(results[column][-1])
    assert speeds == pytest.approx(
        [20.0 / 200 * (1 - np.exp(-200 / 95)), 15.0 / 200 * (1 - np.exp(-200 / 95))], rel=0.02
    )


def test_a_refined_fmu_is_refined_again(tmp_path: Path) -> None:
    first = wrapped_drive(tmp_path, "coulomb", {"coulomb_at_velocity.level": 5.0})
    wrap(first, terms_of("sensor"), {"bias_at_position.offset": 0.5}, tmp_path / "second.fmu")
    force = push(1.0)
    expected = simulated(first, STEPS, force)
    expected[:, 1] += 0.5
    assert off(expected, simulated(tmp_path / "second.fmu", STEPS, force)) == 0.0
    with pytest.raises(CannotWrap, match=r"already has a variable .*coulomb"):
        wrap(first, terms_of("coulomb", states_of("drive")), {}, tmp_path / "third.fmu")


def test_platforms_without_a_compiler_are_left_out_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = slider_fmu(tmp_path / "slider.fmu")
    with zipfile.ZipFile(original, "a") as archive:
        for member in ("linux32/slider.so", "win64/slider.dll", "darwin64/other.txt"):
            archive.writestr(f"binaries/{member}", "library")
    monkeypatch.setattr(compiler, "can_cross", lambda: False)
    wrapped = wrap(original, terms_of("bias"), {}, tmp_path / "w.fmu")
    assert [*wrapped.platforms] == ["linux64"]
    assert sorted(wrapped.left_out) == ["darwin64", "linux32", "win64"]
    monkeypatch.setenv("CC", "none-such")
    with pytest.raises(NoCompiler, match="no C compiler"):
        wrap(original, terms_of("bias"), {}, tmp_path / "never.fmu")
    assert not (tmp_path / "never.fmu").exists()


@pytest.mark.thorough
@pytest.mark.skipif(not compiler.can_cross(), reason="no cross compiler")
@VERSIONS
def test_another_platform_is_compiled_for(fmi: int, tmp_path: Path) -> None:
    original, windows = slider_fmu(tmp_path / "slider.fmu", fmi), PLATFORMS["win64"]
    with zipfile.ZipFile(original, "a") as archive:
        archive.writestr(f"binaries/{windows.folder(fmi)}/slider.dll", "library")
    wrapped = wrap(original, terms_of("coulomb"), {}, tmp_path / "w.fmu", substep=1e-3)
    assert {*wrapped.platforms} == {"linux64", "win64"}
    with zipfile.ZipFile(tmp_path / "w.fmu") as archive:
        assert archive.read(f"binaries/{windows.folder(fmi)}/slider.dll").startswith(b"MZ")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"inputs": ("torque",)}, 'no variable "torque"'),
        ({"states": ("position",)}, "for the states position, but"),
        ({"memory": 1}, "needs a substep"),
        ({"delay": "delay.time"}, "no parameter of the terms"),
    ],
)
def test_terms_of_another_fmu_are_refused(change: dict[str, Any], reason: str, tmp_path: Path) -> None:
    terms = replace(terms_of("coulomb"), **change)
    with pytest.raises(CannotWrap, match=reason):
        wrap(slider_fmu(tmp_path / "slider.fmu", exchange=True), terms, {}, tmp_path / "w.fmu")


@pytest.mark.thorough
def test_the_cost_of_a_step_is_near_that_of_the_original(tmp_path: Path) -> None:
    paths = [
        drive_fmu(2),
        wrapped_drive(tmp_path / "0", "coulomb", {}),
        wrapped_drive(tmp_path / "1", "bias", {"bias_at_force.offset": 1.0}),
    ]
    paths.append(wrapped_drive(tmp_path / "2", "coulomb", {"coulomb_at_velocity.level": 5.0}, substep=None))
    seconds: list[list[float]] = [[] for _ in paths]
    for _ in range(7):
        for k, path in enumerate(paths):
            with Instance(path) as plant:
                plant.initialize({"force": 20.0})
                step, component = plant.fmu.fmi2DoStep, plant.fmu.component
                begin = time.perf_counter()
                for n in range(2000):
                    step(component, n * STEP, STEP, 1)
                seconds[k].append(time.perf_counter() - begin)
    print("wrapper over original:", [min(s) / min(seconds[0]) for s in seconds[1:]])


@pytest.mark.thorough
def test_every_type_and_an_early_end_pass_through(tmp_path: Path) -> None:
    original = typed_fmu(tmp_path)
    lines = {"port_inputs": "out[0] = u[0] + p[0];", "readings": "out[0] = y[0] + p[0] - p[0];"}
    terms = replace(
        terms_of("bias"), source="\n".join(function(hook, text) for hook, text in lines.items()), inputs=("r_in",),
        states=("h", "v"), outputs=("h",), hooks=("port_inputs", "readings"),
    )  # fmt: skip
    wrap(original, terms, {"bias_at_force.offset": 0.5}, tmp_path / "w.fmu", substep=0.002)
    options = {"validate": False, "stop_time": 2.0, "output_interval": STEP, "record_events": True}
    start = {"i_in": 7, "e_in": 2, "b_in": True, "s_in": "text"}
    shown = ["r_out", "i_out", "e_out", "b_out"]
    rows = [
        fmpy.simulate_fmu(str(p), fmi_type=STEPS, output=shown, start_values={**start, "r_in": r}, **options)[-1]
        for p, r in ((original, 3.5), (tmp_path / "w.fmu", 3.0))
    ]
    assert rows[0] == rows[1]
    early = [
        fmpy.simulate_fmu(str(p), fmi_type=STEPS, start_values={"end_at": 0.055}, **options)["time"][-1]
        for p in (original, tmp_path / "w.fmu")
    ]
    assert early[0] == early[1] < 0.1


@pytest.mark.thorough
def test_arrays_pass_through_beside_parameters(tmp_path: Path) -> None:
    terms = replace(terms_of("bias"), source="", inputs=(), states=(), outputs=(), hooks=())
    wrap(typed_fmu(tmp_path, 3), terms, {"bias_at_force.offset": 0.5}, tmp_path / "w.fmu")
    description = fmpy.read_model_description(str(tmp_path / "w.fmu"), validate=False)
    (parameter,) = (v.valueReference for v in description.modelVariables if v.name == "bias_at_force.offset")
    fmu = fmpy.instantiate_fmu(fmpy.extract(str(tmp_path / "w.fmu")), description, STEPS)
    fmu.enterInitializationMode()
    fmu.setFloat64([1, parameter], [1.0, 2.0, 3.0, 4.0, 5.0])
    fmu.exitInitializationMode()
    fmu.setFloat64([1], [5.0, 6.0, 7.0, 8.0])
    fmu.doStep(0.0, STEP)
    assert fmu.getFloat64([parameter, 2], nValues=5) == [5.0, 10.0, 12.0, 14.0, 16.0]
    assert fmu.getFloat64([2], nValues=4) == [10.0, 12.0, 14.0, 16.0]
    fmu.terminate()
    fmu.freeInstance()
