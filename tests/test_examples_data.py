"""The examples on measured data: their models load, their recordings are checked, and their logs are what was recorded.

Recordings are not part of the project: tests that need them look into ../shared/data/NAME, or NAME below the folder
that EXAMPLES_DATA names, and skip without them.
"""

from __future__ import annotations

import csv
import hashlib
import importlib.util
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType, ModuleType

import numpy as np
import pytest

from cosim.fmi.building.file import load_model
from cosim.model import SCALAR
from tests.conftest import ROOT

EXAMPLES = ROOT / "examples"
MODELS = {
    "silverbox": "Silverbox",
    "pendulum": "Pendulum",
    "tclab": "Board",
    "ur10e": "Elbow",
    "ballbeam": "BallBeam",
    "actuator": "Actuator",
}
FILES = {"ur10e": "elbow"}  # others bear the name of the example
FOLDERS = {"drive": ("drive", "emps")}  # others bear the name of the example


def _loaded(path: Path) -> ModuleType:
    name = f"{path.parent.name}_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # a dataclass looks its module up
    spec.loader.exec_module(module)
    return module


def data_of(example: str, files: Sequence[str], copies: Mapping[str, Sequence[str]] = MappingProxyType({})) -> Path:
    """The folder with the recordings of an example; skips without them.

    copies: File → further names of it.
    """
    roots = [ROOT.parent / "shared" / "data"]
    if "EXAMPLES_DATA" in os.environ:
        roots.append(Path(os.environ["EXAMPLES_DATA"]))
    for data in (root / name for root in roots for name in FOLDERS.get(example, (example,))):
        if all(any((data / name).is_file() for name in (file, *copies.get(file, ()))) for file in files):
            return data
    pytest.skip(f"{' and '.join(files)} of examples/{example} not in {', '.join(map(str, roots))}")


def columns(path: Path) -> dict[str, np.ndarray]:
    """Columns of a CSV by name without unit; an empty cell is NaN."""
    with path.open(encoding="utf-8") as stream:
        table = list(csv.DictReader(stream))
    return {name.split()[0]: np.array([float(row[name] or "nan") for row in table]) for name in table[0]}


# -- models -------------------------------------------------------------------------------------


@pytest.mark.parametrize("example", MODELS)
def test_the_model_of_an_example_is_without_fault_and_each_effect_is_felt(example: str) -> None:
    model = load_model(f"{FILES.get(example, example)}.py:{MODELS[example]}", EXAMPLES / example).model
    assert all(p.tolerance for p in model.parameters if p.name in model.calibrated)
    state, command = tuple(0.3 + 0.2 * k for k in range(len(model.base_states))), (0.7,) * len(model.inputs)
    base = model.acting(SCALAR).derivative(0.0, state, command)
    for kind in model.catalogue:
        if kind.delay is None and not kind.memory:  # they shape the command, not the equations
            switches = {n: p for n, p in model.declared.items() if n.startswith(f"{kind.name}.") and p.typical}
            changed = model.with_values({name: p.neutral + p.typical for name, p in switches.items()})
            assert changed.acting(SCALAR).derivative(0.0, state, command) != base, kind.name


# -- recordings ---------------------------------------------------------------------------------


def test_another_file_than_the_recording_is_refused_and_a_download_of_it_not_kept(tmp_path: Path) -> None:
    fetch = _loaded(EXAMPLES / "fetch.py")
    home = tmp_path / "home.csv"
    home.write_bytes(b"1,3\n")
    wrong = hashlib.sha256(b"1,2\n").hexdigest()
    for file, address in (("a.csv", home.as_uri()), ("home.csv", "")):
        with pytest.raises(fetch.RecordingError, match="is not the recording"):
            fetch.recorded(fetch.Recording(file, address, wrong), tmp_path)
    assert [*tmp_path.iterdir()] == [home]
