"""`cosim identify` and `check` on wrong bench recordings: units, signs, columns, cells, ends and rates."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.base.errors import InputError
from cosim.storage.csv_source import write_table
from cosim.verbs.check_verb import check as check_files
from plant.identification.recordings import COLUMNS, runs_of
from plant.identification.workflow import identify
from tests.bench_runs import play_plain, read_protocol
from tests.test_identify import LOADS, short, written

HEADER = ["time", *COLUMNS]
TIME, DUTY, SERVO, HEIGHT, Z, X, M = range(7)
TRUTH = {"thrust_offset": -1900.0, "thrust_slope": 335.0, "z_slope": -0.5, "z_square": -0.03}
Table = np.ndarray[Any, np.dtype[np.float64]]
Change = Callable[[Table], Table]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], dict[str, Table]]:
    """A protocol that reads recordings of all seven tests, and the recordings by file."""
    content = short()
    content["parameters"] = TRUTH
    content["tests"]["ground_effect"]["heights"] = [0.68, 1.25, 2.0]
    for cell, loads in LOADS.items():
        content["cells"][cell] |= {"loads": loads}
    protocol = read_protocol(written(tmp_path_factory.mktemp("truth"), content))
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
        content["cells"][cell] = content["cells"][cell] | {"points": [list(p) for p in zip(loads, volts, strict=True)]}
        del content["cells"][cell]["loads"]
    for key in ("bench", "draws"):
        del content[key]
    content["parameters"] = {"propeller_radius": 0.127}
    return content, tables


def answers(
    good: tuple[dict[str, Any], dict[str, Table]],
    folder: Path,
    name: str,
    change: Change,
    *,
    first_only: bool = False,
    edit: Callable[[dict[str, Any]], None] | None = None,
) -> tuple[str, str]:
    """Return what `check` and `identify` say of one test whose recordings were changed; no numpy warning may appear."""
    content, tables = json.loads(json.dumps(good[0])), good[1]
    content["tests"] = {name: content["tests"][name]}
    if edit is not None:
        edit(content)
    for k, file in enumerate(content["tests"][name]["files"]):
        if file not in tables:
            continue
        table = tables[file].copy()
        write_table(folder / file, HEADER, (table if first_only and k else change(table)).tolist())
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


def microseconds(duty: Table) -> Table:
    return 200.0 * duty


# what is wrong → test, change of each recording, and the column or key that every fault names
CASES: dict[str, tuple[str, Change, str]] = {
    "a dead cell": ("step", column(X, lambda v: 0.0 * v + 1.7), "volts_x"),
    "a cell at its end": ("ground_effect", column(Z, lambda v: 0.0 * v), "volts_z"),
    "millivolts as volts": ("step", column(Z, lambda v: 1000 * v), "volts_z"),
    "a spike": ("thrust_line", lambda t: np.where((np.arange(len(t)) == 350)[:, None] & (np.arange(7) == Z), 9.0, t),
                "volts_z"),
    "servo in µs": ("frequency", column(SERVO, microseconds), "servo_duty"),
    "duty in µs": ("thrust_line", column(DUTY, microseconds), "duty"),
    "heights below 0": ("step", column(HEIGHT, lambda v: -v), "height"),
    "a mirrored servo, test 3": ("projection", column(SERVO, lambda v: 15 - v), "tilt"),
    "a mirrored servo, step": ("step", column(SERVO, lambda v: 15 - v), "tilt"),
    "a mirrored cell, test 3": ("projection", column(X, lambda v: 4.86 - v), "tilt"),
    "cells z and x, test 3": ("projection", swapped(Z, X), "channels"),
    "cells z and x, sines": ("frequency", swapped(Z, X), "channels"),
    "cells x and m, step": ("step", swapped(X, M), "volts_"),
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
def test_good_recordings_have_no_fault_and_no_warning(
    good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    for name in good[0]["tests"]:
        assert answers(good, tmp_path / name, name, lambda t: t) == ("", "")


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[pytest.mark.thorough] if k % 5 else []) for k, case in enumerate(CASES)]
)
def test_a_wrong_recording_is_refused_at_its_place_by_check_and_by_identify(
    case: str, good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    name, change, named = CASES[case]
    checked, identified = answers(good, tmp_path, name, change)
    assert checked
    for line in checked.splitlines():
        place, text = re.fullmatch(rf".*/({name}\d+\.csv:\d+):\d+: (.*)", line).groups()  # type: ignore[union-attr]
        assert named in text, (place, text)
    assert identified == checked


@pytest.mark.thorough
def test_a_missing_row_is_filled_in_and_changes_the_lag_by_little(
    good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    assert answers(good, tmp_path, "step", lambda t: np.delete(t, 350, axis=0), first_only=True) == ("", "")
