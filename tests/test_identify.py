"""`cosim identify`: the tests of ch. 4 and App. D from the bench's FMU, from plain functions, from measured CSVs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML
from typer.testing import CliRunner

from cosim.base.errors import InputError
from cosim.loading.build import build
from cosim.loading.file import read_model
from cosim.model.namespaces import arrays
from cosim.storage.csv_source import write_table
from cosim.verbs.cli import app
from plant.identification.recordings import Recording, runs_of
from plant.identification.workflow import identify
from plant.powertrain import ground_effect
from tests.bench_runs import play_plain, read_protocol
from tests.interval_coverage import coverage

ROOT = Path(__file__).resolve().parent.parent
PROTOCOL = ROOT / "examples" / "bench" / "protocol.yaml"
# Another propeller, of which we know the truth: smaller, slower, on cells of a larger range.
OTHER = {
    "thrust_offset": -1400.0, "thrust_slope": 260.0, "ground_effect_exponent": 1.7, "propeller_radius": 0.1,
    "lag": 0.13, "servo_neutral": 7.1, "servo_slope": 0.33, "z_slope": -0.5, "z_square": -0.03,
}  # fmt: skip
LOADS = {
    "z": [0, 60, 120, 180, 240, 300, 360, 420],
    "x": [-80, -40, 0, 40, 80, 120, 160],
    "m": [-0.02, -0.01, 0, 0.01, 0.02],
}


def short(**tests: Any) -> dict[str, Any]:
    """The shipped protocol with few repetitions and short phases."""
    content = json.loads(json.dumps(YAML(typ="safe").load(PROTOCOL.read_text(encoding="utf-8"))))
    own = content["tests"]
    own["thrust_line"] |= {
        "repetitions": 3, "phases": [[0, 5, 0], [2, 5, 0], [2, 6, 0], [14, 6.6, 0]], "rest": [1, 1.9],
        "window": [5, 14],
    }  # fmt: skip
    own["ground_effect"] |= {
        "heights": [0.68, 1.25],
        "repetitions": 3, "phases": [[0, 5, 0], [1.5, 5, 0], [2, 6.3, 0], [6, 6.3, 0]], "rest": [0.5, 1.4],
        "window": [4, 6],
    }  # fmt: skip
    own["projection"] |= {
        "repetitions": 3, "phases": [[0, 5, 0], [1, 5, 0], [2, 6.3, 0], [4, 6.3, 0], [10, 6.3, 25]], "hold": [3, 4],
        "window": [4, 10],
    }  # fmt: skip
    for name in ("step", "thrust_step"):
        own[name]["repetitions"] = 4
    own["frequency"] |= {"repetitions": 3, "frequencies": [1, 4, 10], "periods": [2, 4, 7], "thesis_skip": [0, 0, 3]}
    own["moment"] |= {
        "repetitions": 3, "phases": [[0, 5, 0], [3, 5, 0], [13, 5, 80]], "rest": [1.5, 3], "window": [3, 13],
    }  # fmt: skip
    content["tests"] = {n: own[n] for n in own if not tests or n in tests}
    for name, changes in tests.items():
        content["tests"][name] |= changes
    return content


def written(folder: Path, content: dict[str, Any], name: str = "protocol.yaml") -> Path:
    path = folder / name
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))  # JSON is YAML
    return path


def as_csv(path: Path, r: Recording, names: tuple[str, ...] = ("volts_z", "volts_x", "volts_m")) -> None:
    header = ["time [s]", "duty [%]", "servo_duty [%]", "height [mm]", *(f"{n} [mV]" for n in names)]
    columns = [r.time, r.duty, r.servo_duty, 1000 * r.height, *(1000 * r.volts[c] for c in "zxm")]
    write_table(path, header, np.column_stack(columns).tolist())


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of another propeller's CSVs, with a protocol that reads them and knows nothing but what is measured."""
    folder = tmp_path_factory.mktemp("measured")
    content = short(thrust_line={}, ground_effect={}, step={})
    content["parameters"] = OTHER
    for c, loads in LOADS.items():
        content["cells"][c] |= {"loads": loads}
    protocol = read_protocol(written(folder, content, "truth.yaml"))
    bench = protocol.bench
    for name in ("thrust_line", "ground_effect", "step"):
        files = []
        for k, r in enumerate(play_plain(bench)(runs_of(protocol, name, 5))):
            files.append(f"{name}{k}.csv")
            as_csv(folder / files[-1], r)
        test = content["tests"][name]
        content["tests"][name] = {k: v for k, v in test.items() if k not in ("phases", "repetitions")} | {
            "files": files
        }
    for c, loads in LOADS.items():
        cell = content["cells"][c]
        unit = 1.0 if c == "m" else 9.81e-3
        curve = [getattr(bench, f"{c}_{power}") for power in ("zero", "slope", "square", "cube")]
        v = [np.polynomial.polynomial.polyval(f * unit, curve) for f in loads]
        del cell["loads"]
        cell["points"] = [[f, float(x)] for f, x in zip(loads, v, strict=True)]
    del content["bench"]
    known = ("propeller_radius", "servo_neutral", "servo_slope")
    content["parameters"] = {n: OTHER[n] for n in known}
    written(folder, content)
    return folder


# -- what is found ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    folder = tmp_path_factory.mktemp("identified")
    path = written(folder, short())
    return folder / "out", identify(path, folder / "out")


@pytest.mark.thorough
def test_the_bench_fmu_gives_its_own_numbers_back(found: tuple[Path, Any]) -> None:
    _, outcome = found
    wide = {k: e for k, e in outcome.estimates.items() if not abs(e.value - e.truth) <= 0.75 * (e.high - e.low)}
    assert len(outcome.estimates) == 9
    assert wide == {}  # within one and a half half-widths; `make seed` counts over 200 seeds
    assert sum(e.covers_truth for e in outcome.estimates.values()) >= 7


@pytest.mark.thorough
def test_the_power_train_is_a_model_that_build_takes_with_intervals_and_origins(
    found: tuple[Path, Any], tmp_path: Path
) -> None:
    out, outcome = found
    loaded = read_model(out / "powertrain.yaml")
    assert loaded.parameters["lag"] == outcome.estimates["step.lag"].value
    content = YAML(typ="safe").load((out / "powertrain.yaml").read_text(encoding="utf-8"))
    assert content["identified"].keys() == {"lag", "ground_effect_exponent", "thrust_offset", "thrust_slope"}
    for name, known in content["identified"].items():
        assert known["ci95"][0] < content["parameters"][name] < known["ci95"][1]
        assert "repetitions" in known["origin"]
    assert {"plant.fmu", "controller.fmu"} <= {p.name for p in build(tmp_path, str(out / "powertrain.yaml"))}


def test_the_nominal_duty_follows_the_new_thrust_line(found: tuple[Path, Any]) -> None:
    model: Any = read_model(found[0] / "powertrain.yaml").model
    gain = ground_effect(arrays(), model.height, model.propeller_radius, model.ground_effect_exponent)
    thrust = (model.thrust_offset + model.thrust_slope * model.duty_nominal) * gain * 9.81e-3
    assert thrust == pytest.approx(2.4973, abs=2e-4)  # T_N, eq 5.36


@pytest.mark.thorough
def test_another_propeller_is_identified_from_its_csvs(measured: Path, tmp_path: Path) -> None:
    outcome = identify(measured / "protocol.yaml", tmp_path)
    for e in outcome.estimates.values():
        assert e.truth != e.truth, "nobody knows the truth of what was measured"
        assert e.low <= OTHER[e.name] <= e.high, e
    assert read_model(tmp_path / "powertrain.yaml").parameters["propeller_radius"] == 0.1


@pytest.mark.thorough
def test_plain_functions_and_seeds_hold_the_truth(tmp_path: Path) -> None:
    rows = coverage(written(tmp_path, short(thrust_line={}, step={})), range(1, 9))
    assert {r.name for r in rows} == {"step.lag", "thrust_line.thrust_offset", "thrust_line.thrust_slope"}
    assert all(r.share >= 0.75 for r in rows)  # of 8; one in a hundred thousand fails where each holds 95 %


# -- bad input --------------------------------------------------------------------------------


def refused(path: Path, out: Path) -> str:
    """The message of a protocol that exits 2 and leaves nothing."""
    done = CliRunner().invoke(app, ["identify", str(path), "--out", str(out)])
    assert isinstance(done.exception, InputError)
    assert done.exception.exit_code == 2
    assert not out.exists() or not list(out.iterdir())
    return str(done.exception)


def changed(measured: Path, folder: Path, change: Any) -> Path:
    """A protocol over the measured files, one of whose tests is another."""
    content = json.loads((measured / "protocol.yaml").read_text())
    for test in content["tests"].values():
        test["files"] = [str(measured / f) for f in test["files"]]
    change(content)
    return written(folder, content)


@pytest.mark.parametrize("cell", [pytest.param("1e5", marks=pytest.mark.thorough), None, 5])
def test_a_cell_that_is_no_cell_is_a_fault_beside_recordings_that_need_it(
    measured: Path, tmp_path: Path, cell: object
) -> None:
    path = changed(measured, tmp_path, lambda content: content["cells"].update(z=cell))
    assert "cells" in refused(path, tmp_path / "out")


def table_of(path: Path) -> tuple[list[str], np.ndarray[Any, Any]]:
    lines = path.read_text().splitlines()
    return lines[0].split(","), np.array([[float(x) for x in line.split(",")] for line in lines[1:]])


def spoilt(measured: Path, folder: Path, test: str, change: Any) -> Path:
    """One recording of a test changed, header and table."""
    header, table = table_of(measured / f"{test}0.csv")
    header, table = change(header, table)
    write_table(folder / "spoilt.csv", header, table.tolist())

    def use(content: dict[str, Any]) -> None:
        content["tests"][test]["files"][0] = "spoilt.csv"

    return changed(measured, folder, use)


def test_a_column_that_is_missing_is_named(measured: Path, tmp_path: Path) -> None:
    path = spoilt(measured, tmp_path, "step", lambda h, t: ([*h[:4], "volt_z [mV]", *h[5:]], t))
    assert "spoilt.csv:1:1: " in refused(path, tmp_path / "out")


def test_too_few_repetitions_are_refused_at_their_line(tmp_path: Path) -> None:
    path = written(tmp_path, short(step={"repetitions": 2}))
    assert "protocol.yaml:1:" in refused(path, tmp_path / "out")
