"""Wrapped FMUs: names, state, instances, refusals, and files of the original."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException

import cosim
from cosim.fmi.native import compiler
from cosim.fmi.native.compiler import NoCompiler
from cosim.fmi.wrapping.wrap import CannotWrap, wrap
from tests.hosts_fmpy import Instance
from tests.native import NEEDS_COMPILER
from tests.slider import slider_fmu
from tests.typed import typed_fmu
from tests.wrapped import EXCHANGE, STEP, STEPS, drive_fmu, function, off, push, simulated, states_of, terms_of

pytestmark = NEEDS_COMPILER
LAG = {"lag_at_force.time": 0.05}


def changed(fmu: Path, change: Callable[[bytes], bytes]) -> Path:
    """Return a copy with another description and another name of its library."""
    path = fmu.with_name("librarian.fmu")
    with zipfile.ZipFile(fmu) as old, zipfile.ZipFile(path, "w") as new:
        for member in old.namelist():
            text = old.read(member)
            text = change(text) if member == "modelDescription.xml" else text
            new.writestr(member.replace("slider.so", "librarian.so"), text)
    return path


def wrapped_drive(folder: Path, kind: str, values: dict[str, float], fmi: int = 2, **options: Any) -> Path:
    path = folder / f"{kind}.fmu"
    wrap(drive_fmu(fmi), terms_of(kind, states_of("drive")), values, path, **{"substep": 1e-3, **options})
    return path


def signature(v: Any) -> tuple[Any, ...]:
    return v.name, v.valueReference, v.type, v.causality, v.variability, v.initial, v.start, v.unit, v.description


@pytest.mark.parametrize("fmi", [2, 3])
def test_variables_are_those_of_the_original_and_the_parameters(fmi: int, tmp_path: Path) -> None:
    paths = [
        wrapped_drive(tmp_path / folder, "coulomb", {"coulomb_at_velocity.level": 7.5}, fmi) for folder in ("a", "b")
    ]
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert fmpy.validation.validate_fmu(str(paths[0])) == []
    one, two = (fmpy.read_model_description(str(p)) for p in (drive_fmu(fmi), paths[0]))
    before, after = one.modelVariables, two.modelVariables
    assert [signature(v) for v in after[: len(before)]] == [signature(v) for v in before]
    (added,) = after[len(before) :]
    assert added.valueReference > max(v.valueReference for v in before)
    assert (added.name, added.start, added.unit) == ("coulomb_at_velocity.level", "7.5", "N")
    assert (added.causality, added.variability, added.initial) == ("parameter", "fixed", "exact")
    assert [u.variable.name for u in two.derivatives] == [u.variable.name for u in one.derivatives]
    assert all(u.dependencies is None for u in two.derivatives)
    assert (one.guid or one.instantiationToken) != (two.guid or two.instantiationToken)


KINDS = [("lag", LAG), ("delay", {"delay.time": 0.043}), ("coulomb", {"coulomb_at_velocity.level": 5.0})]


@pytest.mark.parametrize(("kind", "values"), KINDS)
def test_a_saved_state_holds_the_memory(kind: str, values: dict[str, float], tmp_path: Path) -> None:
    path = wrapped_drive(tmp_path, kind, values, substep=STEP)
    forces = 50.0 * np.random.default_rng(1).standard_normal(40)

    def steps(plant: Instance, first: int, last: int) -> list[dict[str, float]]:
        return [plant.step(k * STEP, STEP, {"force": forces[k]}) for k in range(first, last)]

    with Instance(path) as plant:
        before = steps(plant.initialize(), 0, 20)
        data = plant.serialized()
        first = steps(plant, 20, 40)
        plant.restore(data)
        assert steps(plant, 20, 40) == first
        plant.call("reset")
        assert steps(plant.initialize(), 0, 20) == before
    with Instance(path) as other:  # in another instance
        other.initialize().restore(data)
        assert steps(other, 20, 40) == first
        with pytest.raises(FMICallException):
            other.fmu.deSerializeFMUstate(b"x" * len(data))


@pytest.mark.thorough
def test_a_step_of_fixed_length_is_not_divided(tmp_path: Path) -> None:
    slider = slider_fmu(tmp_path / "slider.fmu")
    fixed = changed(slider, lambda text: text.replace(b'canHandleVariableCommunicationStepSize="true"', b""))
    found = []
    for original, substep in ((fixed, 1e-3), (slider, None), (slider, 1e-3)):
        wrap(original, terms_of("coulomb"), {"coulomb_at_velocity.level": 0.2}, tmp_path / "w.fmu", substep=substep)
        found.append(simulated(tmp_path / "w.fmu", STEPS, push(2.0, 1.0)))
    assert off(found[0], found[1]) == 0.0
    assert off(found[0], found[2]) > 1e-4


@pytest.mark.thorough
@pytest.mark.parametrize(("fmi", "way"), [(2, EXCHANGE), (3, STEPS)])
def test_an_original_with_its_own_resources_and_another_library_name(fmi: int, way: str, tmp_path: Path) -> None:
    slider = slider_fmu(tmp_path / "slider.fmu", fmi, exchange=way == EXCHANGE, follow=True)
    # the library reads this start value from the file beside its resources
    original = changed(slider, lambda text: re.sub(rb'(name="gain".*?start=)"2.0"', rb'\1"3.0"', text, flags=re.DOTALL))
    wrap(original, terms_of("bias"), {"bias_at_force.offset": 1.0, "mass": 2.0}, tmp_path / "w.fmu")
    force = push()
    expected = simulated(slider, way, force + [0.0, 1.0], {"gain": 3.0, "mass": 2.0})  # noqa: RUF005
    assert off(expected, simulated(tmp_path / "w.fmu", way, force)) < 1e-9 * np.ptp(expected[:, 1:])


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
    left_out = wrap(original, terms_of("bias"), {}, tmp_path / "w.fmu")
    assert sorted(left_out) == ["darwin64", "linux32", "win64"]
    with zipfile.ZipFile(tmp_path / "w.fmu") as archive:
        assert [n for n in archive.namelist() if n.startswith("binaries/")] == ["binaries/linux64/slider.so"]
    monkeypatch.setenv("CC", "none-such")
    with pytest.raises(NoCompiler, match="no C compiler"):
        wrap(original, terms_of("bias"), {}, tmp_path / "never.fmu")
    assert not (tmp_path / "never.fmu").exists()


@pytest.mark.thorough
def test_every_type_and_an_early_end_pass_through(tmp_path: Path) -> None:
    original = typed_fmu(tmp_path)
    lines = {"port_inputs": "out[0] = u[0] + p[0];", "readings": "out[0] = y[0] + p[0] - p[0];"}
    terms = replace(
        terms_of("bias"), source="\n".join(function(hook, text) for hook, text in lines.items()), inputs=("r_in",),
        states=("h", "v"), outputs=("h",), hooks=("port_inputs", "readings"),
    )  # fmt: skip
    wrap(original, terms, {"bias_at_force.offset": 0.5}, tmp_path / "w.fmu", substep=0.002)
    start = {"i_in": 7, "e_in": 2, "b_in": True, "s_in": "text"}

    def last(path: Path, **values: object) -> Any:
        return fmpy.simulate_fmu(
            str(path), validate=False, stop_time=2.0, output_interval=STEP, fmi_type=STEPS, record_events=True,
            output=["r_out", "i_out", "e_out", "b_out"], start_values=start | values,
        )[-1]  # fmt: skip

    assert last(original, r_in=3.5) == last(tmp_path / "w.fmu", r_in=3.0)
    assert last(original, end_at=0.055)["time"] == last(tmp_path / "w.fmu", end_at=0.055)["time"] < 0.1


@pytest.mark.thorough
def test_arrays_pass_through_beside_parameters(tmp_path: Path) -> None:
    terms = replace(terms_of("bias"), source="", inputs=(), states=(), outputs=(), hooks=())
    wrap(typed_fmu(tmp_path, 3), terms, {"bias_at_force.offset": 0.5}, tmp_path / "w.fmu")
    start = {"a": [5, 6, 7, 8], "bias_at_force.offset": 5.0}
    component = {"fmu": str(tmp_path / "w.fmu"), "start": start}
    ran = cosim.run({"name": "a", "duration": 2 * STEP, "step": STEP, "components": {"w": component}, "record": ["*"]})
    assert [ran[f"w.twice[{k}]"][-1] for k in ("1,1", "1,2", "2,1", "2,2")] == [10, 12, 14, 16]
    assert ran["w.bias_at_force.offset"][-1] == 5.0
