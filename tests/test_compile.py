"""Sources of an FMU without a library for this platform: compiled and run where the user asks, and only there."""

from __future__ import annotations

import hashlib
import json
import shlex
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

import cosim
from cosim.core.errors import CosimError, FmuError, InputError
from cosim.fmi.native.compiler import compiler
from cosim.verbs.cli import command_line
from tests.bounce1 import bounce_fmu, library
from tests.corpus.inputs import FMU_SOURCES
from tests.typed import TYPED2

ASKED = "it has sources: --compile (in Python compile=True) compiles and runs them"
TWO = '#include "two.h"\n#ifndef BARE\n#error no BARE\n#endif\nint two[TWO == 2 ? 1 : -1];\n'


@pytest.fixture
def compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """How often sources of an FMU were compiled since; its cache is the test's own."""
    library()  # skips where there is no compiler for this platform
    calls, script = tmp_path / "calls", tmp_path / "cc"
    script.write_text(f'#!/bin/sh\necho "$*" >> {shlex.quote(str(calls))}\nexec {shlex.join(compiler() or [])} "$@"\n')
    script.chmod(0o755)
    monkeypatch.setenv("CC", str(script))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def count() -> int:
        lines = calls.read_text().splitlines() if calls.exists() else []
        return sum("model.c" not in line for line in lines)  # the project's own code

    return count


def fmu_of(path: Path, description: str, files: dict[str, str]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description)
        for name, text in files.items():
            archive.writestr(f"sources/{name}", text)
    return path


def fmu2(path: Path, files: dict[str, str] | None = None, listed: tuple[str, ...] = ("typed2.c",)) -> Path:
    """Of FMI 2.0, its sources in the lists of both ways."""
    names = "".join(f'<File name="{name}"/>' for name in listed)
    text = TYPED2.replace('"typed"/>', f'"typed"><SourceFiles>{names}</SourceFiles></ModelExchange>')
    text = text.replace('StepSize="true"/>', f'StepSize="true"><SourceFiles>{names}</SourceFiles></CoSimulation>')
    return fmu_of(path, text, {"typed2.c": (FMU_SOURCES / "typed2.c").read_text()} if files is None else files)


def refusal(*paths: Path, **more: bool) -> str:
    with pytest.raises(CosimError) as caught:
        cosim.check(paths, **more)
    assert caught.value.exit_code == 3  # type: ignore[attr-defined]
    return str(caught.value)


def test_sources_are_compiled_where_it_is_asked_for_alone(tmp_path: Path, compiled: Callable[[], int]) -> None:
    fmu = bounce_fmu(tmp_path / "x.fmu", compiled=False, source=True)
    assert "it has no library for linux64 or another platform; " + ASKED in refusal(fmu)
    cosim.check(fmu, load=False)
    with pytest.raises(InputError, match="--compile: is to load FMUs, which --no-load"):
        cosim.check(fmu, load=False, compile=True)
    with pytest.raises(FmuError, match="--compile"):
        cosim.simulate(fmu)
    assert compiled() == 0
    before = hashlib.sha256(fmu.read_bytes()).hexdigest()
    assert cosim.check(fmu, compile=True) == []
    assert cosim.check(fmu, compile=True) == []
    assert compiled() == 1  # then it is in the cache
    assert ASKED in refusal(fmu)  # which is no leave to run it
    assert hashlib.sha256(fmu.read_bytes()).hexdigest() == before


def test_every_verb_that_runs_an_fmu_compiles_it(
    tmp_path: Path, compiled: Callable[[], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    bounce_fmu(tmp_path / "x.fmu", compiled=False, source=True)
    (tmp_path / "built").mkdir()
    bounce_fmu(tmp_path / "built" / "x.fmu")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.csv").write_text("time,wind,h\n" + "".join(f"{k / 100:.2f},0,1\n" for k in range(30)))

    def done(*command: str) -> str:
        result = CliRunner().invoke(command_line(), list(command))
        assert result.exit_code == 0, (command, result.output, result.exception)
        return result.output

    assert "so it does not run on this machine without --compile" in done("info", "x.fmu")
    done("init", "x.fmu", "-o", "s.yaml")
    done("check", "x.fmu", "s.yaml", "--compile")
    done("run", "s.yaml", "--compile", "--out", "run", "--no-report", "--coupling-error")
    done("simulate", "x.fmu", "--compile", "--out", "alone", "--no-report")
    done("simulate", "x.fmu", "--compile", "--in-process", "--out", "here", "--no-report")
    done("replay", "log.csv", "--plant", "x.fmu", "--compile", "--out", "replay", "--no-report")
    done("linearize", "x.fmu", "--compile", "--out", "linear", "--no-report")
    done("simulate", "built/x.fmu", "--out", "twin", "--no-report")
    assert compiled() == 1
    header, *rows = (tmp_path / "alone" / "results.csv").read_text().splitlines()
    assert rows == (tmp_path / "twin" / "results.csv").read_text().splitlines()[1:]
    assert rows == (tmp_path / "here" / "results.csv").read_text().splitlines()[1:]
    assert "x.h" in header


def test_a_library_for_this_platform_is_taken_before_sources(tmp_path: Path, compiled: Callable[[], int]) -> None:
    assert cosim.check(bounce_fmu(tmp_path / "x.fmu", source=True), compile=True) == []
    assert compiled() == 0


def test_sources_that_do_not_compile_are_refused_with_what_the_compiler_said(
    tmp_path: Path, compiled: Callable[[], int]
) -> None:
    told = refusal(fmu2(tmp_path / "x.fmu", {"typed2.c": "int a;\n#error not for this system\n"}), compile=True)
    assert "its sources do not compile: " in told
    assert "#error not for this system" in told.partition("\n")[2]  # all of it, not the first line alone
    assert "sources/typed2.c:2" in told
    assert str(tmp_path / "cache") not in told


def test_sources_that_are_no_fmu_are_refused(tmp_path: Path, compiled: Callable[[], int]) -> None:
    told = refusal(fmu2(tmp_path / "x.fmu", {"typed2.c": "int a;"}), compile=True)
    assert "is no library that has fmi2GetVersion" in told


@pytest.mark.parametrize("name", ["../modelDescription.xml", "/etc/hostname", "missing.c"])
def test_no_file_outside_the_sources_is_compiled(tmp_path: Path, compiled: Callable[[], int], name: str) -> None:
    told = refusal(fmu2(tmp_path / "x.fmu", listed=("typed2.c", name)), compile=True)
    assert "lies outside its folder" in told or "missing.c, which is not there" in told
    assert compiled() == 0


def test_the_permission_ends_with_the_command(tmp_path: Path, compiled: Callable[[], int]) -> None:
    fmu = bounce_fmu(tmp_path / "x.fmu", compiled=False, source=True)
    cosim.simulate(fmu, in_process=True, compile=True)
    with pytest.raises(FmuError, match="--compile"):
        cosim.simulate(fmu, in_process=True)
    assert json.loads(CliRunner().invoke(command_line(), ["info", str(fmu), "--json"]).output)["runs_here"] is False
