"""FMUs built from a copy of the sources, which a test changes."""

from __future__ import annotations

import shutil
from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest

from cosim.fmi import fmu_build
from tests.conftest import ROOT


def copied_sources(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a copy of the packages for the next builds of this test."""
    for package in ("plant", "controller", "fmus", "cosim"):
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    spec_of = fmu_build.find_spec

    def spec_in_copy(name: str) -> ModuleSpec | None:
        spec = spec_of(name)
        if spec is None or spec.origin is None:
            return spec
        origin = folder / Path(spec.origin).relative_to(ROOT)
        return ModuleSpec(name, None, origin=str(origin), is_package=spec.submodule_search_locations is not None)

    monkeypatch.setattr(fmu_build, "find_spec", spec_in_copy)
    return folder
