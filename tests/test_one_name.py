"""FMUs with code of one name: each executes its own, in every command; what one process cannot hold gets another."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

import cosim
from cosim.core.errors import FmuError
from cosim.fmi.wrapping.wrap import wrap
from cosim.model.quantities import Parameter
from cosim.sweeps.store import TABLE, read_table, signal_of
from cosim.terms.code import TermCode
from tests.amplifier import (
    with_class,
    with_data,
    with_function,
    with_library,
    with_module,
    with_symbol,
    without_library,
)
from tests.lag import component, ssp
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


def scenario(folder: Path, first: str = "1/amp.fmu", second: str = "2/amp.fmu") -> Path:
    path = folder / "two.yaml"
    path.write_text(SCENARIO.format(first, second))
    return path


@pytest.mark.parametrize("form", FORMS)
def test_two_fmus_with_code_of_one_name_execute_their_own(tmp_path: Path, form: str) -> None:
    one, two = FORMS[form](tmp_path / "1" / "amp.fmu", 1.5), FORMS[form](tmp_path / "2" / "amp.fmu", 4.0)
    path = scenario(tmp_path)
    outcome = cosim.run(path, tmp_path / "out", report=False)
    assert (outcome.results["a.y"][-1], outcome.results["b.y"][-1]) == (1.5, 4.0)
    (note,) = [w for w in outcome.manifest["warnings"] if w.startswith("b ")]
    assert note in "\n".join(cosim.check(path))
    for fmu, gain in ((one, 1.5), (two, 4.0)):
        assert cosim.simulate(fmu, tmp_path / "alone", stop=1.0, step=0.5, force=True)["amp.y"][-1] == gain


@pytest.mark.parametrize("form", ["library", "module"])
def test_runs_of_a_sweep_execute_the_code_of_their_fmus(tmp_path: Path, form: str) -> None:
    for k in (1, 2):
        FORMS[form](tmp_path / str(k) / "amp.fmu", float(k))
    (tmp_path / "one.yaml").write_text("name: one\nduration: 1\nstep: 0.5\ncomponents: {a: {fmu: 1/amp.fmu}}\n")
    (tmp_path / "sweep.yaml").write_text(
        "scenario: one.yaml\nsignals: [a.y]\n"
        "vary: {components.a.fmu: {values: [1/amp.fmu, 2/amp.fmu]}, a.u: {values: [1, 10]}}\n"
    )
    done = command("sweep", "sweep.yaml", "--out", "out", "--workers", "1", "--no-report", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    table, _ = read_table(tmp_path / "out" / TABLE)
    assert sorted(signal_of(table, "a.y")[:, -1]) == [1.0, 2.0, 10.0, 20.0]


def test_an_ssp_separates_its_components_and_says_so(tmp_path: Path) -> None:
    fmus = [with_module(tmp_path / str(k) / f"amp{k}.fmu", float(k)) for k in (1, 2)]
    components = "".join(component(f"c{k}", fmu.name) for k, fmu in enumerate(fmus))
    system = f'<ssd:System name="s"><ssd:Elements>{components}</ssd:Elements></ssd:System>'
    path = ssp(tmp_path / "two.ssp", system, {f"resources/{fmu.name}": fmu for fmu in fmus})
    outcome = cosim.run(path, tmp_path / "out", report=False)
    assert (outcome.results["c0.y"][-1], outcome.results["c1.y"][-1]) == (1.0, 2.0)
    (note,) = [w for w in outcome.manifest["warnings"] if w.startswith("c1 ")]
    assert note in "\n".join(cosim.check(path))


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
        cosim.run(scenario(tmp_path), tmp_path / "out", report=False, in_process=True)
    assert refused.value.exit_code == 3


def test_a_module_that_the_process_has_loaded_before_is_named(tmp_path: Path) -> None:
    fmu = tmp_path / "amp.fmu"
    with zipfile.ZipFile(with_module(tmp_path / "h.fmu", 2.0)) as helped, zipfile.ZipFile(fmu, "w") as renamed:
        for name in helped.namelist():
            content = helped.read(name).replace(b"from helper import", b"from platform import")
            renamed.writestr(name.replace("helper.py", "platform.py"), content)
    done = command("simulate", fmu, "--stop", "1", "--step", "0.5", "--no-report", cwd=tmp_path)
    assert done.returncode == 3
    assert "module platform" in done.stderr


def test_equal_code_shares_a_process(tmp_path: Path) -> None:
    for k in (1, 2):
        with_library(tmp_path / str(k) / "amp.fmu", 3.0)
    outcome = cosim.run(scenario(tmp_path), tmp_path / "out", report=False)
    assert (outcome.results["a.y"][-1], outcome.results["b.y"][-1]) == (3.0, 3.0)
    assert not [w for w in outcome.manifest["warnings"] if w.startswith(("a ", "b "))]


@pytest.mark.parametrize(
    ("name", "more"),
    [
        ("y1", ""),  # of libm: the Bessel function
        ("gamma", ""),
        ("PyFloat_AsDouble", ""),  # of Python
        ("index", ""),  # of the C library
    ],
)
def test_an_fmu_calls_its_own_function_of_a_name_that_the_process_has_too(tmp_path: Path, name: str, more: str) -> None:
    fmu = with_function(tmp_path / "own.fmu", name, 2.0, more)
    for in_process in (False, True):
        run = cosim.simulate(fmu, tmp_path / "out", stop=1.0, step=0.5, force=True, in_process=in_process)
        assert run["own.y"].tolist() == [2.0, 2.0, 2.0]


LIBM = "libm.so.6"  # which Python has loaded


def test_an_fmu_that_uses_a_library_of_the_process_in_place_of_its_own_is_warned_of(tmp_path: Path) -> None:
    own = with_library(tmp_path / "own.fmu", 2.0, name="own.so", soname=LIBM, function="y1")
    (loaded,) = {line.split()[-1] for line in Path("/proc/self/maps").read_text().splitlines() if LIBM in line}
    same = tmp_path / "same.fmu"
    with zipfile.ZipFile(own) as given, zipfile.ZipFile(same, "w") as changed:
        for name in given.namelist():
            changed.writestr(name, Path(loaded).read_bytes() if LIBM in name else given.read(name))
    for fmu, warned in ((own, 1), (same, 0)):
        path = scenario(tmp_path, fmu.name, fmu.name)
        outcome = cosim.run(path, tmp_path / "out", report=False, force=True)
        assert outcome.results["a.y"][-1] == pytest.approx(-0.7812128213)  # the Bessel function, not 2
        assert [LIBM in w for w in outcome.manifest["warnings"] if w.startswith("a: ")] == [True] * warned
        for checked, count in ((path, 2 * warned), (fmu, warned)):
            assert sum(LIBM in line and loaded in line for line in cosim.check(checked)) == count


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
    outcome = cosim.run(scenario(tmp_path), tmp_path / "out", report=False)
    assert (outcome.results["a.y"][-1], outcome.results["b.y"][-1]) == (1.0, 2.0)
    wrap(with_function(tmp_path / "own.fmu", "y1", 2.0), BIAS, {}, tmp_path / "wrapped.fmu")
    run = cosim.simulate(tmp_path / "wrapped.fmu", tmp_path / "alone", stop=1.0, step=0.5)
    assert run["wrapped.y"].tolist() == [2.0, 2.0, 2.0]


def test_a_library_that_is_not_in_the_fmu_is_named_with_the_cure(tmp_path: Path) -> None:
    without_library(tmp_path / "amp.fmu")
    done = command("simulate", "amp.fmu", cwd=tmp_path)
    assert done.returncode == 3
    assert "amp.fmu" in done.stderr
    assert "libgain.so" in done.stderr
    assert "LD_LIBRARY_PATH" in done.stderr
    assert len(done.stderr.splitlines()) == 1
