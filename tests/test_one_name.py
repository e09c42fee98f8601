"""FMUs with different code of the same name: each executes its own, in separate processes if necessary."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import cosim
from cosim.core.errors import FmuError
from cosim.fmi.wrapping.wrap import wrap
from cosim.model.quantities import Parameter
from cosim.sweeps.store import SWEEP_TABLE, read_table, signal_of
from cosim.terms.code import TermCode
from tests.amplifier import (
    as_library,
    with_class,
    with_data,
    with_function,
    with_library,
    with_module,
    with_symbol,
    without_library,
)
from tests.warm import cosim as command

FORMS: dict[str, Callable[[Path, float], Path]] = {
    "library": with_library,
    "soname": lambda path, gain: with_library(path, gain, name=f"gain{gain:g}.so", soname="libgain.so.1"),
    "symbol": with_symbol,
    "module": with_module,
    "data": with_data,
    "class": with_class,
}
SCENARIO = "name: two\nduration: 1\nstep: 0.5\ncomponents:\n  a: {{fmu: {0}}}\n  b: {{fmu: {1}}}\n"
ENDS: dict[str, Any] = {"stop": 1.0, "step": 0.5, "force": True}


def ran(folder: Path, first: str = "1/amp.fmu", second: str = "2/amp.fmu", **how: Any) -> tuple[list[float], list[str]]:
    """Return the last outputs of a run of two FMUs, and its warnings."""
    (folder / "two.yaml").write_text(SCENARIO.format(first, second))
    outcome = cosim.run(folder / "two.yaml", folder / "out", report=False, force=True, **how)
    return [outcome[name][-1] for name in ("a.y", "b.y")], outcome.manifest["warnings"]


@pytest.mark.parametrize("form", FORMS)
def test_two_fmus_with_code_of_one_name_execute_their_own(tmp_path: Path, form: str) -> None:
    fmus = {gain: FORMS[form](tmp_path / str(k) / "amp.fmu", gain) for k, gain in ((1, 1.5), (2, 4.0))}
    values, warnings = ran(tmp_path)
    assert values == [*fmus]
    (note,) = [w for w in warnings if w.startswith("b ")]
    assert note in "\n".join(cosim.check(tmp_path / "two.yaml"))
    for gain, fmu in fmus.items():
        assert cosim.simulate(fmu, tmp_path / "alone", **ENDS)["amp.y"][-1] == gain


@pytest.mark.parametrize("turned", [False, True])
def test_a_library_that_an_fmu_needs_is_not_that_of_another_fmu(tmp_path: Path, turned: bool) -> None:
    makers = [as_library, with_library][:: -1 if turned else 1]
    fmus = {
        gain: make(tmp_path / str(k) / "amp.fmu", gain)
        for k, gain, make in zip((1, 2), (1.5, 4.0), makers, strict=True)
    }
    values, _ = ran(tmp_path)
    assert values == [*fmus]


def test_runs_of_a_sweep_execute_the_code_of_their_fmus(tmp_path: Path) -> None:
    for k in (1, 2):
        with_module(tmp_path / str(k) / "amp.fmu", float(k))
    (tmp_path / "one.yaml").write_text("name: one\nduration: 1\nstep: 0.5\ncomponents: {a: {fmu: 1/amp.fmu}}\n")
    (tmp_path / "sweep.yaml").write_text(
        "scenario: one.yaml\nsignals: [a.y]\n"
        "vary: {components.a.fmu: {values: [1/amp.fmu, 2/amp.fmu]}, a.u: {values: [1, 10]}}\n"
    )
    done = command("sweep", "sweep.yaml", "--out", "out", "--workers", "1", "--no-report", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    table, _ = read_table(tmp_path / "out" / SWEEP_TABLE)
    assert sorted(signal_of(table, "a.y")[:, -1]) == [1.0, 2.0, 10.0, 20.0]


def test_logs_are_compared_with_their_own_fmu_in_one_session(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("time,u,y\n0,1,1\n0.5,2,2\n1,3,3\n")
    for gain in (1.0, 2.0, 1.0):
        fmu = with_module(tmp_path / f"{gain:g}" / "amp.fmu", gain)
        replayed = cosim.replay(tmp_path / "log.csv", tmp_path / "out", fmu, report=False, force=True)
        assert replayed["plant.y"][-1] == 2.0 * gain


def test_in_one_process_the_second_is_refused(tmp_path: Path) -> None:
    for k in (1, 2):
        with_module(tmp_path / str(k) / "amp.fmu", float(k), module="one_name_refused")
    with pytest.raises(FmuError, match=r"2.amp.fmu does not load.*one_name_refused.*in_process") as refused:
        ran(tmp_path, in_process=True)
    assert refused.value.exit_code == 3


def test_equal_code_shares_a_process(tmp_path: Path) -> None:
    for k in (1, 2):
        with_library(tmp_path / str(k) / "amp.fmu", 3.0)
    values, warnings = ran(tmp_path)
    assert values == [3.0, 3.0]
    assert not [w for w in warnings if w.startswith(("a ", "b "))]


@pytest.mark.parametrize("name", ["PyFloat_AsDouble", "index"])  # of Python and the C library
@pytest.mark.parametrize("in_process", [False, True])
def test_an_fmu_calls_its_own_function_of_a_name_that_the_process_has_too(
    tmp_path: Path, name: str, in_process: bool
) -> None:
    fmu = with_function(tmp_path / "own.fmu", name, 2.0, "")
    assert cosim.simulate(fmu, tmp_path / "out", in_process=in_process, **ENDS)["own.y"].tolist() == [2.0, 2.0, 2.0]


BIAS = TermCode(
    source="static void readings(double t, const double *y, const double *p, double *out) { out[0] = y[0] + p[0]; }",
    parameters=(Parameter("bias.level", 0.0, "", "added to the output", neutral=0.0),),
    inputs=("u",),
    outputs=("y",),
    hooks=("readings",),
    states=(),
)


def test_wrapped_fmus_execute_their_own_code(tmp_path: Path) -> None:
    for k in (1, 2):
        wrap(with_module(tmp_path / str(k) / "original.fmu", float(k)), BIAS, {}, tmp_path / str(k) / "amp.fmu")
    assert ran(tmp_path)[0] == [1.0, 2.0]


def test_a_library_that_is_not_in_the_fmu_is_named_with_the_cure(tmp_path: Path) -> None:
    without_library(tmp_path / "amp.fmu")
    done = command("simulate", "amp.fmu", cwd=tmp_path)
    assert done.returncode == 3
    for word in ("amp.fmu", "libgain.so", "LD_LIBRARY_PATH"):
        assert word in done.stderr
