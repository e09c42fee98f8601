"""What users install: distributions, the container, CI, editors; and modules that only POSIX has."""

from __future__ import annotations

import functools
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from release import dist, trial
from tests.conftest import ROOT
from tests.test_docs import script_of_docs
from tests.test_first_steps import told

EXAMPLE = tomllib.loads((ROOT / "examples/hovercraft/pyproject.toml").read_text(encoding="utf-8"))
BUILT = ("build", "dist", "results", "egg-info", "tests", "__pycache__", ".fmu", ".venv")


def test_the_staged_sources_are_complete_and_hold_nothing_else(tmp_path: Path) -> None:
    core, example = (dist.stage(parts, tmp_path / name) for parts, name in ((dist.CORE, "a"), (dist.EXAMPLE, "b")))
    text = (example / "pyproject.toml").read_text(encoding="utf-8")
    assert dist.OUTSIDE not in text
    for name in tomllib.loads(text)["tool"]["setuptools"]["packages"]:
        assert (example / name.replace(".", "/") / "__init__.py").is_file()
    assert (core / "cosim" / "report" / "cell" / "templates" / "cell.html.j2").is_file()
    paths = [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")]
    assert [path for path in paths if path.endswith(".fmu") or {*BUILT} & {*path.split("/")}] == []


@pytest.mark.thorough
def test_wheels_are_complete_and_the_same_twice(tmp_path: Path) -> None:
    pytest.importorskip("build", reason="no build")
    first, second = (dist.build(tmp_path / name) for name in ("1", "2"))
    assert [path.name for path in first] == [path.name for path in second]
    assert len(first) == 4
    for one, other in zip(first, second, strict=True):
        if one.suffix == ".whl":
            assert one.read_bytes() == other.read_bytes()
    wheels = {path.name.split("-")[0]: set(zipfile.ZipFile(path).namelist()) for path in first if path.suffix == ".whl"}
    for name, rooms in (("fmu_cosim", ("cosim",)), ("fmu_cosim_hovercraft", ("plant", "controller", "fmus"))):
        tracked = {path.as_posix() for room in rooms for path in dist.tracked(room)}
        assert {path for path in wheels[name] if ".dist-info/" not in path} == tracked


# -- commands and files of the page ---------------------------------------------------------------------


@pytest.mark.thorough
def test_the_commands_of_the_page_and_of_the_container_run_without_network_and_compiler() -> None:
    if not list(dist.DIST.glob("*.whl")) or not (trial.WHEELS / "complete").is_file():
        pytest.skip("`make trial` collects the wheels")
    assert trial.main(["container", "workflow"]) == 0


@pytest.mark.thorough
def test_the_commands_of_the_example_for_ci_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each command of the workflow, without its installation, in a repository as its first lines describe one."""
    (tmp_path / "bin").mkdir()
    program = tmp_path / "bin" / "cosim"
    program.write_text(f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} -m cosim "$@"\n')
    program.chmod(0o755)
    (tmp_path / "fmus").mkdir()
    build = "import sys; from pythonfmu.__main__ import cli_main; cli_main()"
    for name in ("tank", "level_control"):
        command = [sys.executable, "-c", build, "build", "-f", f"{ROOT}/examples/tanks/{name}.py", "--dest", "fmus"]
        subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, timeout=60)
    monkeypatch.chdir(tmp_path)
    told("init", "fmus/Tank.fmu", "fmus/Controller.fmu", "--out", "scenario.yaml")
    summary = tmp_path / "summary.md"
    variables = {"PATH": f"{tmp_path}/bin:/usr/bin:/bin", "GITHUB_STEP_SUMMARY": str(summary), "HOME": str(tmp_path)}
    shell = functools.partial(subprocess.run, env=variables, capture_output=True, text=True, timeout=120)
    bash = ["bash", "--noprofile", "--norc", "-eo", "pipefail", "-c"]
    commands = [line for line in trial.steps(ROOT / "examples/ci/cosim.yml") if "pip install" not in line]
    assert len(commands) >= 3
    for line in commands:
        done = shell([*bash, line])
        assert done.returncode == 0, (line, done.stdout, done.stderr)
    assert "site/run/report.html" in summary.read_text(encoding="utf-8")
    scenario = tmp_path / "scenario.yaml"  # a criterion that is missed fails the job
    scenario.write_text(scenario.read_text(encoding="utf-8") + "criteria: {peak: {of: Tank.level, max: 0.1}}\n")
    (simulate,) = (line for line in commands if line.startswith("cosim run"))
    shutil.rmtree(tmp_path / "site" / "run")
    assert shell([*bash, simulate]).returncode == 5


def test_the_versions_of_the_site_are_listed_with_the_newest_first(tmp_path: Path) -> None:
    site = script_of_docs("site")
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "index.html").write_text("made")
    for version in ("0.9.0", "0.10.0", "0.2.1"):
        site.publish(tmp_path / "made", tmp_path / "all", version)
    page = (tmp_path / "all" / "index.html").read_text(encoding="utf-8")
    assert re.findall(r'href="(.*?)/index.html"', page) == ["0.10.0", "0.9.0", "0.2.1"]
    assert site.faults(tmp_path / "all") == []


# -- systems without POSIX ------------------------------------------------------------------------------

APART = """
import importlib, os, pkgutil, signal, sys
import psutil  # has a part for each system

class Closed:
    def find_spec(self, name, path=None, target=None):
        if name in {"fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty"}:
            raise ImportError(f"{name} is a module of POSIX")

own = {name for name in sys.modules if name in {"fcntl", "grp", "pwd", "resource", "termios"}}
for name in own:
    del sys.modules[name]
sys.meta_path.insert(0, Closed())
for name in ("fork", "geteuid", "getuid", "killpg", "sysconf", "statvfs", "confstr", "sched_getaffinity", "mkfifo"):
    if hasattr(os, name):
        delattr(os, name)
for name in ("SIGKILL", "SIGALRM", "SIGHUP", "SIGUSR1", "setitimer"):
    if hasattr(signal, name):
        delattr(signal, name)
import cosim
names = [found.name for found in pkgutil.walk_packages(cosim.__path__, "cosim.") if "__main__" not in found.name]
for name in names:
    importlib.import_module(name)
print(len(names))
"""


def test_every_module_is_imported_where_modules_of_posix_are_absent() -> None:
    done = subprocess.run([sys.executable, "-c", APART], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 200


@pytest.mark.thorough
@pytest.mark.parametrize("platform", ["win32", "darwin"])
def test_types_are_right_on_other_platforms(platform: str, tmp_path: Path) -> None:
    pytest.importorskip("mypy", reason="no mypy")
    command = [sys.executable, "-m", "mypy", "--platform", platform, "--cache-dir", str(tmp_path), "--no-error-summary"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout
