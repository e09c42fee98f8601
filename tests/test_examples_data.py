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
from typing import Any

import numpy as np
import pytest

from cosim.loading.file import load_model
from cosim.model import SCALAR, Model

ROOT = Path(__file__).resolve().parent.parent
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
YARDSTICKS = ("ur10e", "ballbeam", "actuator")  # examples with a least_squares.py
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


def model_of(example: str) -> Model:
    """The model of an example, checked."""
    return load_model(f"{FILES.get(example, example)}.py:{MODELS[example]}", EXAMPLES / example).model


def data_of(example: str, files: Sequence[str], copies: Mapping[str, Sequence[str]] = MappingProxyType({})) -> Path:
    """The folder with the recordings of an example; skips without them.

    copies: File → further names of it.
    """
    roots = [
        ROOT.parent / "shared" / "data",
        *([Path(os.environ["EXAMPLES_DATA"])] if "EXAMPLES_DATA" in os.environ else []),
    ]
    for data in (root / name for root in roots for name in FOLDERS.get(example, (example,))):
        if all(any((data / name).is_file() for name in (file, *copies.get(file, ()))) for file in files):
            return data
    pytest.skip(f"{' and '.join(files)} of examples/{example} not in {', '.join(map(str, roots))}")


def logs_of(example: str, folder: Path) -> Path:
    """The study of an example, made of its recordings; skips without them."""
    script = _loaded(EXAMPLES / example / "make_logs.py")
    wanted = [r for r in vars(script).values() if type(r).__name__ == "Recording"]
    data = data_of(example, [r.name for r in wanted], {r.name: [*r.copies] for r in wanted})
    return Path(script.make_logs(data, folder))


def columns(path: Path) -> dict[str, np.ndarray]:
    """Columns of a CSV by name without unit; an empty cell is NaN."""
    with path.open(encoding="utf-8") as stream:
        table = list(csv.DictReader(stream))
    return {name.split()[0]: np.array([float(row[name] or "nan") for row in table]) for name in table[0]}


def free_run(
    model: Model, log: dict[str, np.ndarray], start: dict[str, float], interpolated: bool = False
) -> np.ndarray:
    """Outputs at the rows of a log, four steps of RK4 a row; the input held or interpolated."""
    bound, x = model.acting(SCALAR), model.start(start)
    inputs = np.column_stack([log[q.name] for q in model.inputs])
    found = []
    for k, t in enumerate(log["time"]):
        u = inputs[k]
        found.append(bound.output(t, x, tuple(u.tolist())))
        if k + 1 == len(inputs):
            break
        slope = inputs[k + 1] - u if interpolated else 0.0 * u
        h = (log["time"][k + 1] - t) / 4
        for part in range(4):
            at = [tuple((u + slope * (part + c) / 4).tolist()) for c in (0.0, 0.5, 1.0)]
            slopes: list[Any] = [bound.derivative(t, x, at[0])]
            for c, w in ((1, 0.5), (1, 0.5), (2, 1.0)):
                moved = tuple(a + w * h * b for a, b in zip(x, slopes[-1], strict=True))
                slopes.append(bound.derivative(t, moved, at[c]))
            x = tuple(a + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4) for a, k1, k2, k3, k4 in zip(x, *slopes, strict=True))
    return np.array(found)


def rmse(model: Model, log: dict[str, np.ndarray], start: dict[str, float], **how: bool) -> np.ndarray:
    """Of each output, over the rows that have a reading."""
    measured = np.column_stack([log[q.name] for q in model.outputs])
    return np.sqrt(np.nanmean((free_run(model, log, start, **how) - measured) ** 2, axis=0))


# -- models -------------------------------------------------------------------------------------


@pytest.mark.parametrize("example", MODELS)
def test_the_model_of_an_example_is_without_fault(example: str) -> None:
    model = model_of(example)
    assert all(p.tolerance for p in model.parameters if p.name in model.calibrated)


@pytest.mark.parametrize("example", ["silverbox", "pendulum", "tclab", "ur10e", "ballbeam", "actuator"])
def test_an_effect_at_its_typical_size_is_felt_and_at_its_neutral_size_is_not(example: str) -> None:
    model = model_of(example)
    n = len(model.base_states)
    state, command = tuple(0.3 + 0.2 * k for k in range(n)), tuple(0.7 for _ in model.inputs)
    base = model.acting(SCALAR).derivative(0.0, state, command)
    for kind in model.catalogue:
        if kind.delay is not None:
            continue  # it shapes the command, not the equations
        if kind.memory:
            continue  # likewise
        switches = {name: p for name, p in model.declared.items() if name.startswith(f"{kind.name}.") and p.typical}
        shifted = model.with_values({name: p.neutral + p.typical for name, p in switches.items()})
        assert shifted.acting(SCALAR).derivative(0.0, state, command) != base, kind.name
        dormant = model.with_values({name: p.neutral for name, p in switches.items()})
        assert dormant.acting(SCALAR).derivative(0.0, state, command) == base, kind.name


# -- yardsticks ---------------------------------------------------------------------------------


@pytest.mark.parametrize("example", YARDSTICKS)
def test_a_yardstick_has_the_equations_and_values_of_its_model(example: str) -> None:
    model, yardstick = model_of(example), _loaded(EXAMPLES / example / "least_squares.py")
    sensors = model.sensor_parameters
    assert {name: {**model.declared, **sensors}[name].default for name in yardstick.GIVEN} == yardstick.GIVEN
    values = {name: value + 0.1 for name, value in yardstick.GIVEN.items() if name not in sensors}
    state, command = (0.3, -0.2), (0.7,)
    expected = model.with_values(values).acting(SCALAR).derivative(0.0, state, command)
    assert yardstick.derivative(values, state, command) == pytest.approx(expected, rel=1e-12)


def simulated(yardstick: ModuleType, truth: dict[str, float]) -> tuple[Any, Any]:
    """A rig, and a log of it with these parameters."""
    time = 0.1 * np.arange(120.0)
    angle = 0.02 * np.sin(1.3 * time) + 0.01 * np.sin(0.4 * time)
    rig = yardstick.Rig(
        lambda p, x, u: (x[1], p["gain"] * u[0] - p["damping"] * x[1] + p["bend"] * x[0]),
        states=2,
        inputs=("angle",),
        channels=(yardstick.Channel("position", "m", 1.0),),
        horizon=2.0,
        every=2,
        past=1.0,
        substeps=1,
        interpolated=True,
        delay="delay",
    )
    x, positions = (np.zeros(1), np.zeros(1)), []
    log = yardstick.Log(time, angle[None], np.zeros((1, len(time))))
    for k in range(len(time) - 1):
        positions.append(x[0][0])
        x = yardstick._row(rig, log, truth, np.array([k]), x)
    return rig, yardstick.Log(time, angle[None], np.array([[*positions, x[0][0]]]))


def test_a_yardstick_finds_the_parameters_of_a_simulated_rig() -> None:
    yardstick = _loaded(EXAMPLES / "yardstick.py")
    truth = {"gain": 5.0, "damping": 0.3, "delay": 0.15, "bend": 0.0}
    rig, log = simulated(yardstick, truth)
    given = {"gain": 7.0, "damping": 0.0, "delay": 0.0, "bend": 0.0}
    free = {"gain": 7.0, "damping": 0.1, "delay": 0.1}
    fitted = yardstick.fit(rig, [log], given, yardstick.Variant("all", free))
    assert fitted == pytest.approx(truth, rel=1e-4)
    assert yardstick.rms(rig, [log], fitted) == pytest.approx(0.0, abs=1e-7)
    assert yardstick.rms(rig, [log], given) > 0.01


def test_a_yardstick_chooses_the_terms_that_predict_parts_left_out() -> None:
    yardstick = _loaded(EXAMPLES / "yardstick.py")
    rig, log = simulated(yardstick, {"gain": 5.0, "damping": 0.3, "delay": 0.0, "bend": 0.0})
    noise = 1e-3 * np.random.default_rng(1).standard_normal(log.outputs.shape)
    given = {"gain": 7.0, "damping": 0.0, "delay": 0.0, "bend": 0.0}
    base = yardstick.Variant("base", {"gain": 7.0})
    noisy = yardstick.replace(log, outputs=log.outputs + noise)
    assert yardstick.choose(rig, [noisy], given, base, {"bend": 0.1, "damping": 0.1}) == ["damping"]


def test_a_yardstick_reads_what_refine_delivers_and_refuses_what_it_lacks(tmp_path: Path) -> None:
    yardstick = _loaded(EXAMPLES / "yardstick.py")
    (tmp_path / "refine.json").write_text('{"grade": "part"}', encoding="utf-8")
    (tmp_path / "model.yaml").write_text("parameters: {a: 1.0}\nsensors: {bias: 0.1}\n", encoding="utf-8")
    (tmp_path / "nearest.yaml").write_text("parameters: {a: 2.0}\nsensors: {}\n", encoding="utf-8")
    given = {"a": 0.0, "b": 3.0, "bias": 0.0}
    assert yardstick.delivered(given, tmp_path) == {
        "model.yaml": {"a": 1.0, "b": 3.0, "bias": 0.1},
        "nearest.yaml": {"a": 2.0, "b": 3.0, "bias": 0.0},
    }
    with pytest.raises(ValueError, match="bias, which these equations lack"):
        yardstick.delivered({"a": 0.0}, tmp_path)


# -- recordings ---------------------------------------------------------------------------------


def test_a_recording_is_downloaded_once_and_checked(tmp_path: Path) -> None:
    fetch = _loaded(EXAMPLES / "fetch.py")
    home = tmp_path / "home.csv"
    home.write_bytes(b"1,2\n")
    right = fetch.Recording("a.csv", home.as_uri(), hashlib.sha256(b"1,2\n").hexdigest())
    folder = tmp_path / "data"
    assert fetch.recorded(right, folder).read_bytes() == b"1,2\n"
    home.unlink()
    assert fetch.recorded(right, folder) == folder / "a.csv"


def test_another_file_than_the_recording_is_refused_and_a_download_of_it_not_kept(tmp_path: Path) -> None:
    fetch = _loaded(EXAMPLES / "fetch.py")
    home = tmp_path / "home.csv"
    home.write_bytes(b"1,3\n")
    wrong = fetch.Recording("a.csv", home.as_uri(), hashlib.sha256(b"1,2\n").hexdigest())
    with pytest.raises(fetch.RecordingError, match="is not the recording"):
        fetch.recorded(wrong, tmp_path / "data")
    assert not (tmp_path / "data").exists()
    with pytest.raises(fetch.RecordingError, match="is not the recording"):
        fetch.recorded(fetch.Recording("home.csv", "", wrong.sha256), tmp_path)


def test_a_copy_in_other_bytes_has_a_sum_of_its_own(tmp_path: Path) -> None:
    fetch = _loaded(EXAMPLES / "fetch.py")
    (tmp_path / "b.csv").write_bytes(b"1;2\n")
    copies = {"b.csv": hashlib.sha256(b"1;2\n").hexdigest()}
    assert fetch.recorded(fetch.Recording("a.csv", "", "", copies), tmp_path) == tmp_path / "b.csv"


def test_a_home_out_of_reach_says_what_to_put_where(tmp_path: Path) -> None:
    fetch = _loaded(EXAMPLES / "fetch.py")
    lost = fetch.Recording("a.csv", (tmp_path / "none.csv").as_uri(), "")
    with pytest.raises(fetch.RecordingError, match=r"(?s)a\.csv is not in .* cannot be downloaded .* put the file of"):
        fetch.recorded(lost, tmp_path / "data")


# -- on the recordings --------------------------------------------------------------------------


@pytest.mark.thorough
def test_the_silverbox_needs_its_cubic_spring_on_the_arrow(tmp_path: Path) -> None:
    log = columns(logs_of("silverbox", tmp_path).parent / "arrow.csv")
    assert len(log["time"]) == 40_500
    log["V2"] += 0.0055  # the offset at the output
    model = model_of("silverbox")
    # fitted by least squares to the free run over the multisines, by a script that shares nothing with the project
    linear = model.with_values({"frequency": 437.23, "damping": 43.31, "input_gain.gain": 1.0292})
    cubic = {"frequency": 429.25, "damping": 41.74, "input_gain.gain": 1.0502, "cubic_spring.coefficient": 3.970}
    assert 0.0135 < rmse(linear, log, {}, interpolated=True) < 0.0150
    assert rmse(model.with_values(cubic), log, {}, interpolated=True) < 0.0012
