"""Fixtures: the FMUs, built once a test session and shared by its workers."""

from __future__ import annotations

import gc
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from cosim.core.program import collect_seldom
from cosim.fmi.building.build import build_native
from cosim.fmi.fmu_build import Recipe, build
from cosim.fmi.native import compiler as c_compiler
from cosim.fmi.native.compiler import compiler
from cosim.isolation import process
from fmus.recipes import controller_recipe, plant_recipe

try:
    import fcntl
except ImportError:  # on Windows each worker builds its own
    fcntl = None  # type: ignore[assignment]

ROOT = Path(__file__).resolve().parent.parent
SHIPPED = c_compiler.OPTIONS
QUICK = tuple(option.replace("-O3", "-O1") for option in SHIPPED)
# every command and worker would compile anew all that it imports
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
collect_seldom()  # as commands do
MEMORY, ROOM = Path("/dev/shm"), 4e9  # a folder in memory, free bytes for all files of a session


def _keep_files_in_memory() -> None:
    """Put temporary files where no disk is waited for, if there is such a folder and the user has not chosen one."""
    if "TMPDIR" not in os.environ and MEMORY.is_dir():
        system = os.statvfs(MEMORY)
        if system.f_bavail * system.f_frsize > ROOM and not system.f_flag & os.ST_NOEXEC:
            os.environ["TMPDIR"] = tempfile.tempdir = str(MEMORY)


_keep_files_in_memory()


def pytest_collection_finish() -> None:
    """Leave what is imported and collected out of later collections of garbage."""
    gc.collect()
    gc.freeze()


# the files that take longest, first: begun last, one of them would be waited for alone
LONGEST = (
    "test_refine", "test_refine_fmu", "test_verbs", "test_misbehaving", "test_live_browser", "test_resume",
    "test_fit", "test_view_browser", "test_identify", "test_extensions", "test_blind_fmu", "test_kernel",
    "test_effects", "test_sweep", "test_refine_report", "test_run", "test_replay", "test_python_arguments",
    "test_controllers", "test_report", "test_wrapping", "test_step_control", "test_wrapped_calls",
    "test_report_charts", "test_subject", "test_shared_machine", "test_release", "test_recording",
    "test_commands_of_docs",
)  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first."""
    place = {name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


def _session(factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the session, shared by its workers."""
    base = factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(autouse=True, scope="session")
def _private_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Cache designs and kernels in a folder of this session, so that no test depends on an earlier session."""
    before, cache = os.environ.get("XDG_CACHE_HOME"), _session(tmp_path_factory) / "cache"
    cache.mkdir(exist_ok=True)
    os.environ["XDG_CACHE_HOME"] = str(cache)
    yield
    if before is None:
        del os.environ["XDG_CACHE_HOME"]
    else:
        os.environ["XDG_CACHE_HOME"] = before


@pytest.fixture(scope="session")
def _forker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Fork workers if the system supports it."""
    if not sys.platform.startswith("linux"):
        yield None
        return
    from tests.warm import Forker

    forker = Forker(_session(tmp_path_factory))
    yield forker
    forker.end()


@pytest.fixture(autouse=True)
def _warm_workers(request: pytest.FixtureRequest, _forker: Any) -> Iterator[None]:
    """Fork the workers of this process (`tests/warm.py`), except for tests marked `fresh`.

    Fresh ones compile as shipped; so must the test, which may compile for them.
    """
    fresh, options = process._spawn, c_compiler.OPTIONS
    if request.node.get_closest_marker("fresh") is not None:
        c_compiler.OPTIONS = SHIPPED
    elif _forker is not None:
        process._spawn = _forker.spawn
    yield
    process._spawn, c_compiler.OPTIONS = fresh, options


@pytest.fixture(autouse=True, scope="module")
def _quick_compiler(request: pytest.FixtureRequest) -> Iterator[None]:
    """Compile at -O1: the same bits in less than half the time, except for modules marked `optimized`."""
    if request.node.get_closest_marker("optimized") is None:
        c_compiler.OPTIONS = QUICK
    yield
    c_compiler.OPTIONS = SHIPPED


def _built_once(factory: pytest.TempPathFactory, name: str, fill: Callable[[Path], object]) -> Path:
    """Return a folder of the session, filled by its first user while all others wait."""
    if fcntl is None:
        folder = factory.mktemp(name)
        fill(folder)
        return folder
    place = _session(factory) / name
    with place.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # until it is closed
        if not place.is_dir():
            draft = place.with_suffix(".draft")
            shutil.rmtree(draft, ignore_errors=True)  # of a worker that was stopped
            draft.mkdir()
            fill(draft)
            draft.rename(place)
    return place


def _python_fmu(name: str, recipe: Recipe, factory: pytest.TempPathFactory, forker: Any) -> Path:
    """Return an FMU in Python, whose modules forked workers have."""
    path = _built_once(factory, name, lambda folder: build(recipe, folder / f"{name}.fmu")) / f"{name}.fmu"
    if forker is not None:
        forker.know(path)
    return path


@pytest.fixture(scope="session")
def plant_fmu(tmp_path_factory: pytest.TempPathFactory, _forker: Any) -> Path:
    return _python_fmu("plant", plant_recipe(), tmp_path_factory, _forker)


@pytest.fixture(scope="session")
def controller_fmu(tmp_path_factory: pytest.TempPathFactory, _forker: Any) -> Path:
    return _python_fmu("controller", controller_recipe(), tmp_path_factory, _forker)


@pytest.fixture(scope="session")
def native_fmus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the native plant and controller for FMI 2.0."""
    if compiler() is None:
        pytest.skip("no C compiler")

    def fill(folder: Path) -> None:
        before, c_compiler.OPTIONS = c_compiler.OPTIONS, QUICK  # whoever is first, as the modules build
        build_native(folder, "hovercraft")
        c_compiler.OPTIONS = before

    return _built_once(tmp_path_factory, "native", fill)


@pytest.fixture(scope="session")
def native_plant(native_fmus: Path) -> Path:
    return native_fmus / "plant-native.fmu"


@pytest.fixture
def fmu(which: str, request: pytest.FixtureRequest) -> Path:
    """The FMU of which a test has the name."""
    path: Path = request.getfixturevalue(which)
    return path


@pytest.fixture
def project(tmp_path: Path, plant_fmu: Path, controller_fmu: Path) -> Path:
    """A folder laid out as the project: scenarios/ and build/ with both FMUs."""
    shutil.copytree(ROOT / "scenarios", tmp_path / "scenarios")
    (tmp_path / "build").mkdir()
    shutil.copy(plant_fmu, tmp_path / "build" / "plant.fmu")
    shutil.copy(controller_fmu, tmp_path / "build" / "controller.fmu")
    return tmp_path
