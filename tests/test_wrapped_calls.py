"""Wrapped FMUs: names, state, instances, refusals, and files of the original."""

from __future__ import annotations

import re
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
from cosim.fmi.wrapping.wrap import CannotWrap, wrap
from tests.hosts_fmpy import Instance
from tests.native import NEEDS_COMPILER
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
