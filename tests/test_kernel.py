"""The filter in C: the same numbers from every compiler, from the cache, and step by step those of the FMU."""

from __future__ import annotations

import math
import os
import sys
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from cosim.core.arrays import Array
from cosim.estimation.kernel import backend
from cosim.estimation.kernel.backend import kernel
from cosim.estimation.kernel.generate import KNOTS, bump, generate, rise
from cosim.estimation.kernel.kernel import CORRELATION_TIME, Data, Layout
from cosim.estimation.kernel.library_kernel import CompiledKernel
from cosim.estimation.subject.model_subject import neutral_values
from cosim.files.cache import cache_path
from cosim.fmi.building.file import own_model
from cosim.fmi.native.compiler import compiler
from cosim.model import Model, Stepper
from tests.conftest import ROOT
from tests.logs import times
from tests.table import TABLE

NEEDS_C = pytest.mark.skipif(compiler() is None, reason="no C compiler on this machine")


@pytest.fixture(autouse=True)
def none_made_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kernels are made once a process: here each test makes its own."""
    monkeypatch.setattr(backend, "_kernels", {})


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Model:
    """The model that docs/own_model.md shows."""
    folder = tmp_path_factory.mktemp("table")
    (folder / "table.py").write_text(TABLE, encoding="utf-8")
    return own_model("table.py:Table", folder)


def parameters(model: Model, layout: Layout, **changes: float) -> Array:
    values = dict.fromkeys(layout.parameters, 0.0) | neutral_values(model) | {CORRELATION_TIME: 0.15} | changes
    return np.array([values[name] for name in layout.parameters])


@NEEDS_C
def test_a_covariance_stays_one_on_an_unstable_plant_with_fine_sensors() -> None:
    """An arm that stands upright for 20 s: an asymmetry by rounding doubles every 0.06 s."""
    arm = own_model("arm.py:Arm", ROOT / "tests" / "blind" / "plants")
    made, rows = kernel(arm, ("angle_1", "angle_2")), 4000
    layout, p = made.layout, parameters(arm, made.layout)
    upright = np.tile([0.5 * math.pi, 0.0], (rows, 1))
    data = Data(0.005, 0.0, np.zeros((rows, 2)), upright, 2)
    x0 = np.array([0.5 * math.pi, *np.zeros(len(layout.states) - 1)])
    q, wide = np.full(len(layout.stochastic), 1e-6), 0.01 * np.eye(len(layout.stochastic))
    run = made.run(data, p, x0, wide, q, np.full(2, 1e-10), states=True)
    assert run.covariances is not None
    assert (run.variances > 1e-10).all()
    np.testing.assert_allclose(run.covariances, run.covariances.transpose(0, 2, 1), rtol=1e-9)


STAND_IN = """import subprocess, sys
words = sys.argv[1:]
assert words[0] == "cc", words
at = words.index("-target")
sys.exit(subprocess.run([*{command!r}, *words[1:at], *words[at + 2:]]).returncode)
"""


@NEEDS_C
@pytest.mark.parametrize("cc", ["", "no-such-compiler"])
def test_without_a_compiler_that_works_that_of_the_extra_takes_its_place(
    table: Model, monkeypatch: pytest.MonkeyPatch, cc: str, tmp_path: Path
) -> None:
    (tmp_path / "ziglang").mkdir()
    (tmp_path / "ziglang" / "__init__.py").touch()
    (tmp_path / "ziglang" / "__main__.py").write_text(STAND_IN.format(command=compiler()))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "ziglang", raising=False)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("CC", cc)
    assert steps_as_the_fmu(kernel(table, ("angle",)), table)


@NEEDS_C
def test_a_damaged_cache_of_c_is_made_anew(table: Model, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    generated = generate(table, ("angle",))
    CompiledKernel(generated)
    for file in [path for path in cache_path("", "").parent.rglob("*") if path.is_file()]:
        file.unlink()  # the one loaded above is mapped
        file.write_bytes(b"damaged")
    assert steps_as_the_fmu(CompiledKernel(generated), table)


def steps_as_the_fmu(k: CompiledKernel, table: Model) -> bool:
    """Compare a run without readings with that of the FMU's integrator."""
    torque = 0.1 * np.sin(2.0 * times(2.0))[:, None]
    data = Data(0.02, 0.0, torque, np.full_like(torque, np.nan), 4)
    run = k.simulate(data, parameters(table, k.layout, **{"dry_friction.level": 0.05}), np.zeros(3), np.zeros(0))
    assert not run.states[:, 2].any()  # an unknown input that is none stays none
    stepper = Stepper(table.with_values({"dry_friction.level": 0.05}))
    moment = stepper.start()
    for state, u in zip(run.states[:, :2], torque.tolist(), strict=True):
        assert state == pytest.approx(moment.state, rel=1e-9, abs=1e-12)  # the same steps, sums in another order
        moment = stepper.step(moment, tuple(u), 0.02)
    return True


@NEEDS_C
def test_rows_simulated_at_once_are_those_of_single_simulations(table: Model) -> None:
    made, count, length = kernel(table, ("angle",)), 40, 3
    p = parameters(table, made.layout, **{"dry_friction.level": 0.05})
    data = Data(0.02, 1.0, 0.1 * np.sin(times(0.8))[:count, None], np.full((count, 1), np.nan), 2)
    rows, states = [0, 7, count - 2, count - 1], np.arange(12.0).reshape(4, 3)
    at_once = made.simulate_from(data, p, (rows, states, np.zeros((4, 0))), length)
    for row, state, run in zip(rows, states, at_once, strict=True):
        single = made.simulate(data.rows(0, row + length + 1), p, state, np.zeros(0), first=row)
        assert run.states.shape[0] == min(length + 1, count - row)
        np.testing.assert_array_equal(run.states, single.states[row:])
        np.testing.assert_array_equal(run.outputs, single.outputs[row:])


SHAPES = {"rise": rise, "sin": np.sin, "cos": np.cos} | {
    str(k): (lambda z, k=k: bump(z - k)) for k in (0, 3, KNOTS - 1)
}


@NEEDS_C
def test_local_shapes_and_their_slopes_are_those_of_the_regressors(table: Model) -> None:
    made, wide = kernel(table, ("angle",), unnamed=True), 0.3
    nothing, nowhere = Data(0.02, 0.0, np.zeros((1, 1)), np.zeros((1, 1)), 1), np.zeros(0)
    noise = np.zeros(len(made.layout.stochastic)), np.ones(1)
    P0 = np.diag([wide if name == "angle" else 0.0 for name in made.layout.uncertain])
    for (name, shape), slot in product(SHAPES.items(), (1, 2)):
        of = f"local.{slot}."
        settings = {f"{of}of.angle": 1.5, f"{of}of.1": -0.2, f"{of}by.1": 2.0, f"{of}to.reading of angle": 1.0}
        p = parameters(table, made.layout, **settings, **{of + name: 0.7})
        for angle in np.linspace(-2.05, 6.95, 13):  # between the kinks
            x0 = np.array([angle, *np.zeros(len(made.layout.states) - 1)])
            added = made.simulate(nothing, p, x0, nowhere).outputs[0, 0] - angle
            slope = np.sqrt((made.run(nothing, p, x0, P0, *noise).variances[0, 0] - 1.0) / wide)
            ends = np.array([-1e-6, 1e-6]) + 1.5 * angle - 0.2
            expected = 1.0 + 1.4 * 1.5 * float(np.diff(shape(ends))[0] / 2e-6)
            assert added == pytest.approx(1.4 * float(shape(1.5 * angle - 0.2)), abs=1e-12), name
            assert slope == pytest.approx(abs(expected), abs=1e-6), name
