"""`cosim identify`: the tests of ch. 4 and App. D from the bench's FMU, from plain functions, from measured CSVs."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML

from cosim.core.errors import InputError
from cosim.files.csv_source import write_table
from cosim.fmi.building.build import build
from cosim.fmi.building.file import read_model
from cosim.model.namespaces import arrays
from cosim.verbs.checks import check as check_files
from plant.identification.recordings import COLUMNS, runs_of
from plant.identification.workflow import identify
from plant.powertrain import ground_effect
from tests.bench_runs import play_plain, read_protocol

ROOT = Path(__file__).resolve().parent.parent
PROTOCOL = ROOT / "examples" / "bench" / "protocol.yaml"
HEADER = ["time", *(q.name for q in COLUMNS)]
TIME, DUTY, SERVO, HEIGHT, Z, X, M = range(7)
Table = np.ndarray[Any, np.dtype[np.float64]]
Change = Callable[[Table], Table]
# Another propeller, of which we know the truth: smaller, slower, on cells of a larger range.
OTHER = {
    "thrust_offset": -1400.0, "thrust_slope": 260.0, "ground_effect_exponent": 1.7, "propeller_radius": 0.1,
    "lag": 0.13, "servo_neutral": 7.1, "servo_slope": 0.33, "z_slope": -0.5, "z_square": -0.03,
}  # fmt: skip
TRUTH = {"thrust_offset": -1900.0, "thrust_slope": 335.0, "z_slope": -0.5, "z_square": -0.03}
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


def measured(
    folder: Path, content: dict[str, Any], truth: dict[str, float], known: tuple[str, ...]
) -> dict[str, Table]:
    """Turn a simulated protocol into one of recordings, which knows only what is measured; return them by file."""
    content["parameters"] = truth
    for cell, loads in LOADS.items():
        content["cells"][cell] |= {"loads": loads}
    protocol = read_protocol(written(folder, content, "truth.yaml"))
    tables = {}
    played = ("phases", "repetitions", "heights", "amplitude", "validation_duty")
    for name, _ in protocol.file.tests.named_tests():
        runs = play_plain(protocol.bench)(runs_of(protocol, name, 5))
        files = [f"{name}{k}.csv" for k in range(len(runs))]
        for file, r in zip(files, runs, strict=True):
            tables[file] = np.column_stack([r.time, r.duty, r.servo_duty, r.height, *(r.volts[c] for c in "zxm")])
        kept = {key: value for key, value in content["tests"][name].items() if key not in played}
        content["tests"][name] = kept | {"files": files}
    for cell, loads in LOADS.items():
        unit = 1.0 if cell == "m" else 9.81e-3
        curve = [getattr(protocol.bench, f"{cell}_{power}") for power in ("zero", "slope", "square", "cube")]
        volts = [float(np.polynomial.polynomial.polyval(load * unit, curve)) for load in loads]
        content["cells"][cell]["points"] = [list(p) for p in zip(loads, volts, strict=True)]
        del content["cells"][cell]["loads"]
    for key in ("bench", "draws"):
        del content[key]
    content["parameters"] = {n: truth[n] for n in known}
    return tables


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
def test_another_propeller_is_identified_from_its_csvs(tmp_path: Path) -> None:
    content = short(thrust_line={}, ground_effect={}, step={})
    tables = measured(tmp_path, content, OTHER, ("propeller_radius", "servo_neutral", "servo_slope"))
    header = ["time [s]", "duty [%]", "servo_duty [%]", "height [mm]", *(f"volts_{c} [mV]" for c in "zxm")]
    for file, table in tables.items():
        write_table(tmp_path / file, header, (table * [1, 1, 1, *[1000] * 4]).tolist())
    outcome = identify(written(tmp_path, content), tmp_path / "out")
    for e in outcome.estimates.values():
        assert e.truth != e.truth, "nobody knows the truth of what was measured"
        assert e.low <= OTHER[e.name] <= e.high, e
    assert read_model(tmp_path / "out" / "powertrain.yaml").parameters["propeller_radius"] == 0.1


# -- wrong recordings -------------------------------------------------------------------------

Good = tuple[dict[str, Any], dict[str, Table]]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Good:
    """A protocol that reads recordings of all seven tests, and the recordings by file."""
    content = short()
    content["tests"]["ground_effect"]["heights"] = [0.68, 1.25, 2.0]
    tables = measured(
        tmp_path_factory.mktemp("truth"), content, TRUTH | {"propeller_radius": 0.127}, ("propeller_radius",)
    )
    return content, tables


def answers(
    good: Good, folder: Path, name: str, change: Change, *, first_only: bool = False, header: list[str] = HEADER
) -> tuple[str, str]:
    """Return what `check` and `identify` say of one test whose recordings were changed; no numpy warning may appear."""
    content, tables = json.loads(json.dumps(good[0])), good[1]
    content["tests"] = {name: content["tests"][name]}
    for k, file in enumerate(content["tests"][name]["files"]):
        table = tables[file].copy()
        write_table(folder / file, header, (table if first_only and k else change(table)).tolist())
    path = written(folder, content)
    texts = []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for run in (lambda: check_files([path]), lambda: identify(path, folder / "out").warnings):
            try:
                texts.append("\n".join(run()))
            except InputError as error:
                texts.append(str(error))
                assert not (folder / "out").exists() or not list((folder / "out").iterdir())
    return texts[0], texts[1]


def column(place: int, change: Callable[[Table], Table]) -> Change:
    def changed(table: Table) -> Table:
        table[:, place] = change(table[:, place])
        return table

    return changed


def swapped(one: int, other: int) -> Change:
    def changed(table: Table) -> Table:
        table[:, [one, other]] = table[:, [other, one]]
        return table

    return changed


# what is wrong → test, change of each recording, and the column or key that every fault names
WRONG: dict[str, tuple[str, Change, str]] = {
    "a dead cell": ("step", column(X, lambda v: 0.0 * v + 1.7), "volts_x"),
    "a cell at its end": ("ground_effect", column(Z, lambda v: 0.0 * v), "volts_z"),
    "millivolts as volts": ("step", column(Z, lambda v: 1000 * v), "volts_z"),
    "a spike": ("thrust_line", lambda t: np.where((np.arange(len(t)) == 350)[:, None] & (np.arange(7) == Z), 9.0, t),
                "volts_z"),
    "servo in µs": ("frequency", column(SERVO, lambda v: 200.0 * v), "servo_duty"),
    "heights below 0": ("step", column(HEIGHT, lambda v: -v), "height"),
    "a mirrored servo, test 3": ("projection", column(SERVO, lambda v: 15 - v), "tilt"),
    "cells z and x, test 3": ("projection", swapped(Z, X), "channels"),
    "cells z and m, test 5": ("moment", swapped(Z, M), "channels"),
    "half the slope of the servo": ("frequency", column(SERVO, lambda v: 7.5 + 0.5 * (v - 7.5)), "volts_z"),
    "no thrust": ("step", column(DUTY, lambda v: 0.0 * v + 5.0), "duty"),
    "no rest": ("thrust_line", column(DUTY, lambda v: np.maximum(v, 7.0)), "duty"),
    "no step": ("step", column(SERVO, lambda v: 0.0 * v + 7.5), "servo_duty"),
    "a motor that runs": ("moment", lambda t: np.where((np.arange(7) == DUTY) & (t[:, [TIME]] > 5), 6.5, t), "duty"),
    "a recording that was cut, step": ("step", lambda t: t[:315], "window"),
    "a clock in ms": ("step", column(TIME, lambda v: 1000 * v), "rows"),
    "a clock that restarts": ("step", column(TIME, lambda v: np.where(v > 4, v - 4, v)), "time"),
}  # fmt: skip


@pytest.mark.thorough
def test_good_recordings_have_no_fault_and_no_warning(good: Good, tmp_path: Path) -> None:
    for name in good[0]["tests"]:
        assert answers(good, tmp_path / name, name, lambda t: t) == ("", "")


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[pytest.mark.thorough] if k % 5 else []) for k, case in enumerate(WRONG)]
)
def test_a_wrong_recording_is_refused_at_its_place_by_check_and_by_identify(
    case: str, good: Good, tmp_path: Path
) -> None:
    name, change, named = WRONG[case]
    checked, identified = answers(good, tmp_path, name, change)
    assert checked
    for line in checked.splitlines():
        place, text = re.fullmatch(rf".*/({name}\d+\.csv:\d+):\d+: (.*)", line).groups()  # type: ignore[union-attr]
        assert named in text, (place, text)
    assert identified == checked


@pytest.mark.thorough
def test_a_missing_row_is_filled_in_and_changes_the_lag_by_little(good: Good, tmp_path: Path) -> None:
    assert answers(good, tmp_path, "step", lambda t: np.delete(t, 350, axis=0), first_only=True) == ("", "")


def test_a_column_that_is_missing_is_named(good: Good, tmp_path: Path) -> None:
    checked, identified = answers(good, tmp_path, "step", lambda t: t, header=[*HEADER[:4], "volt_z", *HEADER[5:]])
    assert "step0.csv:1:5: " in checked
    assert identified == checked


# -- protocols --------------------------------------------------------------------------------


def faults_of(path: Path) -> list[str]:
    with pytest.raises(InputError) as found:
        check_files([path])
    assert found.value.exit_code == 2
    return [str(f) for f in found.value.faults]


@pytest.mark.parametrize("cell", ["1e5", None, 5])
def test_a_cell_that_is_no_cell_is_a_fault_beside_recordings_that_need_it(
    good: Good, tmp_path: Path, cell: object
) -> None:
    content = json.loads(json.dumps(good[0]))
    content["cells"]["z"] = cell
    assert any("cells" in fault for fault in faults_of(written(tmp_path, content)))


def test_too_few_repetitions_are_refused_at_their_line_and_leave_nothing(tmp_path: Path) -> None:
    path = written(tmp_path, short(step={"repetitions": 2}))
    assert all("protocol.yaml:1:" in fault for fault in faults_of(path))
    with pytest.raises(InputError):
        identify(path, tmp_path / "out")
    assert not list(tmp_path.glob("out/*"))


# the test, its changes, and the keys at fault
PHASES: dict[str, tuple[str, dict[str, Any], int]] = {
    "a step elsewhere": ("step", {"at": 5}, 1),
    "a step that is small": (
        "step", {"phases": [[0, 5, 0], [1, 5, 0], [3, 6.4, 0], [6, 6.4, 0], [6, 6.4, 4.9], [9, 6.4, 4.9]]}, 1,
    ),
    "a window before the step": ("step", {"window": [3.5, 5.5]}, 1),
    "a window that ends with the step": ("step", {"window": [5.9, 6.1]}, 1),
    "rest under thrust": ("step", {"rest": [4, 5.9]}, 1),
    "a validation without thrust": ("ground_effect", {"validation_duty": 5}, 1),
    "equal heights": ("ground_effect", {"heights": [0.68, 0.68, 0.68]}, 1),
    "heights in the ground": ("ground_effect", {"heights": [0.2, 1.25]}, 1),
    "a free height that is none": ("ground_effect", {"free_height": 0.05}, 1),
    "thrust that begins in the window": ("ground_effect", {"window": [1.8, 4]}, 1),
    "no thrust": (
        "thrust_line", {"phases": [[0, 5, 0], [5, 4, 0], [65, 5.5, 0]], "rest": [1, 1.9], "window": [5, 65]}, 1,
    ),
    "a motor that runs": ("moment", {"phases": [[0, 5, 0], [3, 5, 0], [13, 6, 80]]}, 1),
    "a sine without thrust": ("frequency", {"duty": 5.2}, 1),
    "a sine between rows": ("frequency", {"frequencies": [1, 4, 100]}, 1),
}  # fmt: skip


@pytest.mark.parametrize("case", PHASES)
def test_check_refuses_phases_that_tell_nothing_once_at_their_line(case: str, tmp_path: Path) -> None:
    name, changes, count = PHASES[case]
    faults = faults_of(written(tmp_path, short(**{name: changes})))
    assert len(faults) == count, faults  # however many runs are alike
    assert all("protocol.yaml:1:" in fault for fault in faults)


def test_the_phases_of_the_shipped_protocol_tell_what_they_are_for() -> None:
    assert check_files([PROTOCOL]) == []
