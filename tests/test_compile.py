"""FMUs without a library for this platform: their sources are compiled and executed only on request."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.core.errors import FmuError, InputError
from cosim.fmi.native.compiler import compiler
from tests.bounce1 import SOURCE, bounce_fmu
from tests.compiled import library, pack
from tests.corpus.inputs import FMU_SOURCES
from tests.test_first_steps import told
from tests.typed import typed_text


@pytest.fixture
def compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """How often sources of an FMU were compiled since; its cache is the test's own."""
    library(SOURCE)  # skips where there is no compiler for this platform
    calls, script = tmp_path / "calls", tmp_path / "cc"
    script.write_text(f'#!/bin/sh\necho "$*" >> {shlex.quote(str(calls))}\nexec {shlex.join(compiler() or [])} "$@"\n')
    script.chmod(0o755)
    monkeypatch.setenv("CC", str(script))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def count() -> int:
        lines = calls.read_text().splitlines() if calls.exists() else []
        return sum("model.c" not in line for line in lines)  # the project's own code

    return count


def fmu2(path: Path, text: str = "", listed: str = "") -> Path:
    """Of FMI 2.0, its sources in the lists of both ways."""
    names = "".join(f'<File name="{name}"/>' for name in ("typed2.c", *listed.split()))
    described = typed_text().replace('"typed"/>', f'"typed"><SourceFiles>{names}</SourceFiles></ModelExchange>')
    described = described.replace(
        'StepSize="true"/>', f'StepSize="true"><SourceFiles>{names}</SourceFiles></CoSimulation>'
    )
    return pack(path, described, None, {"sources/typed2.c": text or (FMU_SOURCES / "typed2.c").read_text()})


def refusal(path: Path, compile: bool = False) -> str:
    with pytest.raises(InputError) as caught:
        cosim.check(path, compile=compile)
    assert caught.value.exit_code == 3
    return str(caught.value)


def test_sources_are_compiled_where_it_is_asked_for_alone(tmp_path: Path, compiled: Callable[[], int]) -> None:
    fmu = bounce_fmu(tmp_path / "x.fmu", compiled=False, source=True)
    assert "--compile" in refusal(fmu)
    cosim.check(fmu, load=False)
    with pytest.raises(InputError, match=r"--compile: .* --no-load"):
        cosim.check(fmu, load=False, compile=True)
    with pytest.raises(FmuError, match="--compile"):
        cosim.simulate(fmu)
    assert compiled() == 0
    before = fmu.read_bytes()
    for _ in range(2):
        assert cosim.check(fmu, compile=True) == []
    cosim.simulate(fmu, in_process=True, compile=True)
    assert compiled() == 1  # then it is in the cache
    assert "--compile" in refusal(fmu)  # which is no leave to run it
    with pytest.raises(FmuError, match="--compile"):
        cosim.simulate(fmu, in_process=True)
    assert fmu.read_bytes() == before
    assert cosim.check(bounce_fmu(tmp_path / "both.fmu", source=True), compile=True) == []  # its library comes first
    assert compiled() == 1


def test_every_verb_that_runs_an_fmu_compiles_it_also_of_fmi_1(
    tmp_path: Path, compiled: Callable[[], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    bounce_fmu(tmp_path / "x.fmu", compiled=False, source=True)
    (tmp_path / "built").mkdir()
    bounce_fmu(tmp_path / "built" / "x.fmu")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.csv").write_text("time,wind,h\n" + "".join(f"{k / 100:.2f},0,1\n" for k in range(30)))

    for words in (
        "check x.fmu --compile",
        "init x.fmu -o s.yaml",
        "check s.yaml --compile",
        "run s.yaml --compile --out run --no-report --coupling-error",
        "simulate x.fmu --compile --out alone --no-report",
        "simulate x.fmu --compile --in-process --out here --no-report",
        "replay log.csv --plant x.fmu --compile --out replay --no-report",
        "linearize x.fmu --compile --out linear --no-report",
        "simulate built/x.fmu --out twin --no-report",
    ):
        told(*words.split())
    assert compiled() == 1
    rows = [(tmp_path / name / "results.csv").read_text().splitlines()[1:] for name in ("alone", "here", "twin")]
    assert rows[0] == rows[1] == rows[2]
    assert json.loads(told("info", "x.fmu", "--json"))["runs_here"] is False
    linear = json.loads((tmp_path / "linear" / "linear.json").read_text())
    assert linear["states"] == ["h", "v"]  # by their value references, and not an alias of the other sign
    assert np.array(linear["models"][0]["A"]) == pytest.approx(np.array([[0, 1], [0, 0]]), abs=1e-6)
    assert np.array(linear["models"][0]["B"]) == pytest.approx(np.array([[0], [1]]), abs=1e-6)


def test_sources_that_do_not_compile_or_are_no_fmu_are_refused(tmp_path: Path, compiled: Callable[[], int]) -> None:
    told = refusal(fmu2(tmp_path / "x.fmu", "int a;\n#error not for this system\n"), compile=True)
    assert "sources/typed2.c:2" in told
    assert "#error not for this system" in told.partition("\n")[2]  # all of it, not the first line alone
    assert str(tmp_path / "cache") not in told
    assert "has no function fmi2" in refusal(fmu2(tmp_path / "x.fmu", "int a;"), compile=True)
    count = compiled()
    for name in ("../modelDescription.xml", "/etc/hostname", "missing.c"):  # nothing outside of the sources
        refusal(fmu2(tmp_path / "x.fmu", listed=name), compile=True)
    assert compiled() == count
