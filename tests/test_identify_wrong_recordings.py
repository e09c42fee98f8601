"""`cosim identify` and `check` on wrong bench recordings: units, signs, columns, cells, copies, ends and rates."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.base.errors import InputError
from cosim.storage.csv_source import write_table
from cosim.verbs.check_verb import check as check_files
from plant.identification.columns import COLUMNS
from plant.identification.equal_readings import equal_readings
from plant.identification.estimates import Measurement
from plant.identification.misfit import misfit, odd_group
from plant.identification.odd_commands import odd_commands
from plant.identification.recordings import SimulatedRecording, read_recording, runs_of
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


def stuck(place: int, share: float, rows: int | None = None) -> Change:
    def changed(table: Table) -> Table:
        first = int(share * len(table))
        table[first : len(table) if rows is None else first + rows, place] = table[first, place]
        return table

    return changed


def microseconds(duty: Table) -> Table:
    return 200.0 * duty


PULSE = "such as 7.5 for a pulse of 1500 µs in a frame of 20 ms"
MIRRORED = "the horizontal force leans against the commanded tilt (factor -"
CASES: dict[str, tuple[str, Change, str]] = {
    "a clipped cell, test 1": ("thrust_line", column(Z, lambda v: np.maximum(v, 2.3)), "its extreme, at"),
    "a clipped cell, test 3": ("projection", column(X, lambda v: np.maximum(v, 2.1)), "its extreme, at"),
    "a clipped cell, test 4": ("step", column(X, lambda v: np.maximum(v, 2.1)), "its extreme, at"),
    "a stuck cell, test 1": ("thrust_line", stuck(Z, 0.6, 60), "volts_z stands still at"),
    "a stuck cell, test 2": ("ground_effect", stuck(Z, 0.8), "volts_z"),
    "a stuck cell, step": ("step", stuck(X, 0.65, 60), "is at its end, or stuck"),
    "a stuck cell, sines": ("frequency", stuck(X, 0.55, 60), "volts_x stands still at"),
    "a stuck cell, test 5": ("moment", stuck(M, 0.6, 60), "volts_m stands still at"),
    "a cell that is read each fifth row": (
        "step", column(X, lambda v: np.repeat(v[::5], 5)[: v.size]), "volts_x repeats each reading",
    ),
    "a coarse cell": ("moment", column(M, lambda v: np.round(v / 5e-3) * 5e-3), "is recorded in steps of 0.005 V"),
    "servo in µs, step": ("step", column(SERVO, microseconds), f"servo_duty is 1500 % here, beyond 0 to 100 % (duty of "
                          f"the servo); write it in % of the frame, {PULSE}"),
    "servo in µs, sines": ("frequency", column(SERVO, microseconds), "servo_duty is 1500 % here"),
    "servo in µs, test 5": ("moment", column(SERVO, microseconds), "servo_duty is 1500 % here"),
    "servo in degrees": ("step", column(SERVO, lambda v: (v - 7.5) * 22.5), "is a tilt of -169°, beyond ±120°"),
    "servo as a share": ("frequency", column(SERVO, lambda v: v / 100), "is a tilt of -167°, beyond ±120°"),
    "duty in µs, test 1": ("thrust_line", column(DUTY, microseconds), "duty is 1000 % here"),
    "duty in µs, thrust": ("thrust_step", column(DUTY, microseconds), "duty is 1000 % here"),
    "duty as a share": ("step", column(DUTY, lambda v: v / 100), "as of a share of one, duty [1]"),
    "a mirrored servo, test 3": ("projection", column(SERVO, lambda v: 15 - v), MIRRORED),
    "a mirrored servo, step": ("step", column(SERVO, lambda v: 15 - v), "turn the sign of `servo_slope` under"),
    "a mirrored cell, test 3": ("projection", column(X, lambda v: 4.86 - v), MIRRORED),
    "a mirrored cell, sines": ("frequency", column(X, lambda v: 4.86 - v), MIRRORED),
    "heights in mm, test 3": ("projection", column(HEIGHT, lambda v: 1000 * v), "height is 95 m here, beyond 0 to 20"),
    "heights in mm, test 4": ("step", column(HEIGHT, lambda v: 1000 * v), "height is 95 m here, beyond 0 to 20"),
    "heights in cm, test 4": ("frequency", column(HEIGHT, lambda v: 100 * v), "height is 9.5 m, and 0.095 m in the"),
    "heights in radii": ("ground_effect", column(HEIGHT, lambda v: v / 0.127), "beyond 0 to 20 m"),
    "heights in radii near": (
        "ground_effect", column(HEIGHT, lambda v: np.where(v > 5, v, v / 0.127)), "above 3 radii of the propeller",
    ),
    "heights below 0": ("step", column(HEIGHT, lambda v: -v), "height is -0.095 m here"),
    "a height that moves": ("moment", column(HEIGHT, lambda v: np.linspace(0.1, 1, v.size)), "height goes from"),
    "cells z and x, test 3": ("projection", swapped(Z, X), "are the channels swapped?"),
    "cells z and m, test 3": ("projection", swapped(Z, M), "are the channels swapped?"),
    "cells x and m, test 3": ("projection", swapped(X, M), "are the channels swapped?"),
    "cells z and x, sines": ("frequency", swapped(Z, X), "are the channels swapped?"),
    "cells x and m, sines": ("frequency", swapped(X, M), "are the channels swapped?"),
    "cells z and m, test 5": ("moment", swapped(Z, M), "at rest, and cell m without load"),
    "cells x and m, test 5": ("moment", swapped(X, M), "at rest, and cell m without load"),
    "servo and height": ("thrust_step", swapped(SERVO, HEIGHT), "is a tilt of"),
    "a recording that was cut, step": ("step", lambda t: t[:315], "the phase `window` from 6 to 8 s is missing"),
    "a recording that was cut, test 5": ("moment", lambda t: t[:450], "the phase `window` from 3 to 13 s is missing"),
    "a recording that was cut, sines": ("frequency", lambda t: t[:230], "before a whole period after what is skipped"),
    "10 Hz, sines": ("frequency", lambda t: t[::5], "rows are 0.1 s apart, fewer than 10 in a period of 10 rad/s"),
    "commands resampled by straight lines": (
        "frequency", column(SERVO, lambda v: np.interp(np.arange(v.size), np.arange(0, v.size, 2), v[::2])),
        "only one row in 2 of servo_duty is a command",
    ),
    "half the slope of the servo": (
        "frequency", column(SERVO, lambda v: 7.5 + 0.5 * (v - 7.5)), "times the thrust of volts_z times sin α",
    ),
    "a clock 10 % slow, sines": (
        "frequency", column(TIME, lambda v: 1.1 * v), "is 9.09 rad/s, and the protocol has 10 rad/s",
    ),
    "a clock 5 % slow, sines": (
        "frequency", column(TIME, lambda v: 1.05 * v), "is 0.952 rad/s, and the protocol has 1 rad/s",
    ),
    "a step that ends upright": (
        "step", column(SERVO, lambda v: 7.5 + v.max() - v), "the step ends at 0.0°, upright, where a tilt has no",
    ),
    "a clock since 1970": ("step", column(TIME, lambda v: v + 1.7e9), "a clock that does not begin at 0 s"),
    "a clock that restarts": ("step", column(TIME, lambda v: np.where(v > 4, v - 4, v)), "does not increase"),
}  # fmt: skip


@pytest.mark.thorough
def test_good_recordings_have_no_fault_and_no_warning(
    good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    for name in good[0]["tests"]:
        assert answers(good, tmp_path / name, name, lambda t: t) == ("", "")


@pytest.mark.thorough
@pytest.mark.parametrize("case", CASES)
def test_a_wrong_recording_is_refused_with_its_reason_by_check_and_by_identify(
    case: str, good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    name, change, reason = CASES[case]
    checked, identified = answers(good, tmp_path, name, change)
    assert reason in checked
    assert identified == checked


@pytest.mark.thorough
@pytest.mark.parametrize("copy", ["cut", "rounded", "later"])
def test_a_copy_is_no_repetition_though_it_was_cut_rounded_or_shifted(
    copy: str, good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    original = good[1]["step1.csv"]

    def copied(table: Table) -> Table:
        table = original.copy()
        if copy == "cut":
            return table[:-3]
        if copy == "later":
            table[:, TIME] += 0.001
        else:
            table[:, Z:] = np.round(table[:, Z:], 3)
        return table

    checked, identified = answers(good, tmp_path, "step", copied, first_only=True)
    assert "step1.csv: holds the readings of step0.csv once more" in checked
    assert identified == checked


@pytest.mark.thorough
def test_a_spike_is_no_force_of_another_channel_and_makes_no_copies(
    good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    def spike(table: Table) -> Table:
        table[350, Z:] = 0.5
        return table

    checked, _ = answers(good, tmp_path, "thrust_line", spike)
    assert "swapped" not in checked
    assert "once more" not in checked


def lone(place: int, row: int, volts: float) -> Change:
    """Return a change of one reading."""

    def changed(table: Table) -> Table:
        table[row, place] = volts
        return table

    return changed


@pytest.mark.thorough
@pytest.mark.parametrize("row", [255, 300, 400])
@pytest.mark.parametrize("volts", [0.0, 3.3])
def test_a_lone_reading_at_the_rail_of_the_ramp_is_a_dropout(
    volts: float, row: int, good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    checked, identified = answers(good, tmp_path, "thrust_line", lone(Z, row, volts), first_only=True)
    assert f"thrust_line0.csv:{row + 2}:1: volts_z is {volts:g} V here, and the readings beside it are not" in checked
    assert len(checked.splitlines()) == 1
    assert identified == checked


@pytest.mark.thorough
@pytest.mark.parametrize("first", [250, 300])
@pytest.mark.parametrize("volts", [0.0, 3.3])
def test_a_ramp_that_ends_at_the_rail_names_the_reading(
    first: int, volts: float, good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    def changed(table: Table) -> Table:
        table[first : first + 8, Z] = volts
        return table

    checked, identified = answers(good, tmp_path, "thrust_line", changed, first_only=True)
    assert "the ramp has too few readings with thrust within the range of the cell" in checked
    assert (
        f"The range ends with {volts:g} V at {good[1]['thrust_line0.csv'][first, DUTY]:.4g} %, thrust_line0.csv:"
        in checked
    )
    assert identified == checked


DROPOUTS = [
    (name, place, row, volts)
    for name, place, rows in [
        ("projection", X, (0, 250)), ("projection", Z, (300,)), ("moment", M, (1, 300)), ("step", X, (20, 301, 400)),
        ("thrust_step", Z, (302, 350)), ("frequency", X, (200, 230)), ("ground_effect", Z, (250,)),
    ]
    for row in rows
    for volts in (0.0, 0.02)
]  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "place", "row", "volts"), DROPOUTS)
def test_a_single_dropout_is_named_with_its_column_and_row(
    name: str, place: int, row: int, volts: float, good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    checked, identified = answers(good, tmp_path, name, lone(place, row, volts), first_only=True)
    assert f"{name}0.csv:{row + 2}:1: volts_{'zxm'[place - Z]} is {volts:g} V here" in checked
    assert len(checked.splitlines()) == 1
    assert identified == checked


@pytest.mark.thorough
@pytest.mark.parametrize("run", [3, 6])  # the first of 4 and of 10 rad/s
def test_a_cell_mirrored_at_one_frequency_is_named(
    run: int, good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    content, tables = good
    files = [f"frequency{k}.csv" for k in range(run, run + 3)]
    mirrored = {file: column(X, lambda v: 4.86 - v)(tables[file].copy()) for file in files}
    checked, identified = answers((content, {**tables, **mirrored}), tmp_path, "frequency", lambda t: t)
    assert checked.count("leans against the commanded tilt (phase") == 3
    assert all(file in checked for file in files)
    assert identified == checked


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "place"), [("moment", M), ("projection", X)])
def test_one_mirrored_recording_of_few_is_named(
    name: str, place: int, good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    content, tables = good
    rest = tables[f"{name}1.csv"][:40, place].mean()
    mirrored = column(place, lambda v: 2.0 * rest - v)(tables[f"{name}1.csv"].copy())
    checked, identified = answers((content, {**tables, f"{name}1.csv": mirrored}), tmp_path, name, lambda t: t)
    assert f"{name}1.csv" in checked
    assert "mirrored" in checked or MIRRORED in checked
    assert identified in checked


@pytest.mark.thorough
def test_commands_of_a_sweep_that_were_recorded_late_are_named(
    good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    late = column(SERVO, lambda v: np.concatenate((np.full(20, v[0]), v[:-20])))
    checked, identified = answers(good, tmp_path, "projection", late)
    assert "ahead of the commanded tilt: were the commands recorded late?" in checked
    assert identified in checked


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "place"), [("thrust_line", Z), ("projection", X), ("moment", M)])
def test_a_cell_that_slips_in_every_repetition_is_named(
    name: str, place: int, good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    start, end = good[0]["tests"][name]["window"]

    def slip(table: Table) -> Table:
        table[table[:, TIME] > 0.4 * start + 0.6 * end, place] += 0.03
        return table

    checked, identified = answers(good, tmp_path, name, slip)
    assert f"cell {'zxm'[place - Z]} jumps by" in checked
    assert identified in checked


@pytest.mark.thorough
def test_frequencies_may_stand_in_any_order(good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path) -> None:
    def turn(content: dict[str, Any]) -> None:
        test = content["tests"]["frequency"]
        for key in {"frequencies", "periods", "thesis_skip"} & test.keys():
            test[key] = test[key][::-1]

    for name, edit in (("plain", lambda content: None), ("turned", turn)):
        assert answers(good, tmp_path / name, "frequency", lambda t: t, edit=edit) == ("", "")
    results = [json.loads((tmp_path / name / "out" / "identify.json").read_text()) for name in ("plain", "turned")]
    assert results[0]["estimates"] == results[1]["estimates"]


@pytest.mark.thorough
def test_a_wrong_parameter_is_not_blamed_on_the_recordings(
    good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    content, tables = good
    wrong = {**content, "parameters": {**content["parameters"], "propeller_radius": 100.0}}
    checked, identified = answers((wrong, tables), tmp_path, "ground_effect", lambda t: t)
    assert "propeller_radius is 100.0" in checked
    assert ".csv" not in checked
    assert identified == checked


@pytest.mark.thorough
def test_10_hz_is_enough_for_a_step_but_not_for_the_thesis_estimator_and_says_so(
    good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    checked, identified = answers(good, tmp_path, "step", lambda t: t[::5])
    assert "rows are 0.1 s apart, more than the lag" in checked
    assert identified in checked


CELLS: dict[str, tuple[str, Callable[[str, Any], Any], str]] = {
    "loads in kg": (
        "thrust_line", lambda _, c: {"points": [[a / 1000, v] for a, v in c["points"]], "full_scale": 0.816},
        "thrust_slope comes out as 0.33",
    ),
    "loads in N said to be gf": (
        "thrust_line", lambda _, c: {"points": [[a * 9.81e-3, v] for a, v in c["points"]]}, "the loads span 4.12 gf",
    ),
    "loads in gf said to be N": ("thrust_line", lambda _, c: {"unit": "N"}, "thrust_offset comes out as -1.93e+05 gf"),
    "a unit of mass": ("thrust_line", lambda _, c: {"unit": "kg"}, "a mass that is hung is a force: write kgf"),
    "a mistyped point": (
        "thrust_line", lambda n, c: {"points": [[a, v + 0.1 * (k == 3)] for k, (a, v) in enumerate(c["points"])]},
        "off the curve through the other points",
    ),
    "points in mV": ("step", lambda _, c: {"points": [[a, 1000 * v] for a, v in c["points"]]}, "beyond the"),
    "load and voltage swapped": ("step", lambda _, c: {"points": [[v, a] for a, v in c["points"]]}, "the loads span"),
    "a load beyond full scale": ("step", lambda _, c: {"full_scale": 8}, "is beyond the cell's full_scale of 8 gf"),
    "an error in percent": ("step", lambda _, c: {"error": 0.25}, "less than or equal to 0.1"),
    "loads of the other sign": (
        "projection", lambda n, c: {"points": [[-a, v] for a, v in c["points"]]} if n == "x" else {}, MIRRORED,
    ),
    "moments in N mm": (
        "moment", lambda n, c: {"points": [[1000 * a, v] for a, v in c["points"]], "full_scale": 28.2},
        "assembly_arm comes out as -0.1",
    ),
}  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize("case", CELLS)
def test_a_wrong_calibration_is_refused_with_its_reason(
    case: str, good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    name, change, reason = CELLS[case]
    channels = ("m",) if name == "moment" else ("z", "x")

    def edit(content: dict[str, Any]) -> None:
        for channel in channels:
            content["cells"][channel] |= change(channel, content["cells"][channel])

    checked, identified = answers(good, tmp_path, name, lambda t: t, edit=edit)
    assert reason in checked
    assert identified == checked


@pytest.mark.thorough
def test_a_run_on_another_day_gives_an_exponent_that_is_refused(
    good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    content, tables = good
    weak = {
        **tables,
        "ground_effect3.csv": column(Z, lambda v: 3.25 - 0.6 * (3.25 - v))(tables["ground_effect3.csv"].copy()),
    }
    checked, identified = answers((content, weak), tmp_path, "ground_effect", lambda t: t)
    assert "ground_effect_exponent comes out as 0.4" in checked
    assert identified == checked


@pytest.mark.thorough
def test_an_interval_that_contains_an_impossible_value_is_named(
    good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    content, tables = good
    tilted = {**tables}
    ramp = tables["thrust_line0.csv"].copy()
    ramp[:, Z] += 1.5 * np.maximum(ramp[:, DUTY] - 6.0, 0.0)  # a cell that fades in one of three runs
    tilted["thrust_line0.csv"] = ramp
    checked, identified = answers((content, tilted), tmp_path, "thrust_line", lambda t: t)
    assert "the interval of thrust_offset" in checked
    assert "contains impossible values (-10000 to 0 gf is possible)" in checked
    assert all(line in checked for line in identified.splitlines())


@pytest.mark.thorough
def test_a_height_that_the_equation_misses_is_named(
    good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    wrong = column(HEIGHT, lambda v: np.where(np.abs(v - 1.25 * 0.127) < 1e-3, 0.09, v))
    checked, identified = answers(good, tmp_path, "ground_effect", wrong)
    assert "more than the scatter explains: look at `propeller_radius` and at the heights" in checked
    assert identified in checked


def test_a_quiet_cell_on_a_coarse_converter_is_not_stuck() -> None:
    rng = np.random.default_rng(3)
    time = 0.02 * np.arange(450)
    force = np.where(time > 6.0, 1.0 - np.exp(-(time - 6.0) / 0.09), 0.0)
    volts = np.round((2.4 - 0.5 * force + 1e-3 * rng.standard_normal(450)) / 0.01) * 0.01  # noise of a tenth of a step
    window, rest, rail = (time >= 6.0) & (time <= 8.0), time < 1.0, np.zeros(450, dtype=bool)
    assert equal_readings(volts, window, rest, rail) is None
    fine = 2.4 - 0.5 * force + 1e-3 * rng.standard_normal(450)
    fine[330:360] = fine[330]
    found = equal_readings(fine, window, rest, rail)
    assert found is not None
    assert (found.kind, found.row, found.count) == ("stuck", 330, 30)


def shifted(rows: int) -> Change:
    """Cells that are late by a number of rows, or ahead by as many below 0."""

    def changed(table: Table) -> Table:
        places = np.clip(np.arange(len(table)) - rows, 0, len(table) - 1)
        table[:, Z:] = table[places, Z:]
        return table

    return changed


def added(place: int, of_time: Callable[[Table], Table]) -> Change:
    def changed(table: Table) -> Table:
        table[:, place] += of_time(table[:, TIME])
        return table

    return changed


def rested(table: Table) -> Table:
    """The recording goes on as it began, without thrust."""
    again = table[: np.searchsorted(table[:, TIME], 2.0)].copy()
    again[:, TIME] += table[-1, TIME] + table[1, TIME] - table[0, TIME]
    return np.vstack([table, again])


def averaged(table: Table) -> Table:
    padded = np.r_[np.full(20, table[0, Z]), table[:, Z]]
    table[:, Z] = np.convolve(padded, np.ones(21) / 21, "valid")
    return table


def noise(size: int) -> Table:
    return np.asarray(np.random.default_rng(size).standard_normal(size))


SHAPES: dict[str, tuple[str, Change, str]] = {
    "cells ahead, step": ("step", shifted(-5), "the force moves some 0.1 s before its command"),
    "cells ahead, thrust": ("thrust_step", shifted(-5), "the force moves some 0.1 s before its command"),
    "cells late, step": ("step", shifted(5), "the force answers some 0.1 s late"),
    "cells late, sines": ("frequency", shifted(5), "s late, as a pure delay does"),
    "hum": ("step", added(X, lambda t: 0.1 * np.sin(2 * np.pi * 53 * t)), "a sine of"),
    "a slow motor": ("thrust_step", averaged, "it is not of first order"),
    "a clipped cell with noise": (
        "step", column(X, lambda v: np.where(v < 2.1, 2.1 + 0.002 * noise(v.size), v)), "has less noise after the step",
    ),
    "a cell that drifts, test 1": (
        "thrust_line", lambda t: added(Z, lambda time: -0.02 * time)(rested(t)), "it drifts, and offset and slope",
    ),
    "a cell that drifts, test 5": ("moment", added(M, lambda t: 0.005 * t), "cell m drifts by"),
    "an unplugged cell, test 5": (
        "moment", column(M, lambda v: 1.7184 + 0.002 * noise(v.size)), "volts_m does not answer the sweep",
    ),
}  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize("case", SHAPES)
def test_an_answer_of_the_wrong_shape_is_named(
    case: str, good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    name, change, reason = SHAPES[case]
    checked, identified = answers(good, tmp_path, name, change)
    assert reason in checked
    assert reason in identified


@pytest.mark.thorough
def test_a_missing_row_is_filled_in_and_changes_the_lag_by_little(
    good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    assert answers(good, tmp_path, "step", lambda t: np.delete(t, 100, 0), first_only=True) == ("", "")


@pytest.mark.thorough
def test_faults_of_files_that_can_be_read_stand_beside_those_that_cannot(
    good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    content, tables = good
    wrong = {**tables, "step0.csv": tables["step0.csv"][:5], "step1.csv": microseconds_of_servo(tables["step1.csv"])}
    checked, _ = answers((content, wrong), tmp_path, "step", lambda t: t)
    assert "step0.csv: holds 5 rows" in checked
    assert "step1.csv:2:1: servo_duty is 1500 % here" in checked


def microseconds_of_servo(table: Table) -> Table:
    return column(SERVO, microseconds)(table.copy())


def test_decimal_commas_are_one_line_a_file(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = "".join(f"{t};5;7,5;0,095;3,25;2,43;1,72\n" for t in ("0", "0,02", "0,04", *(f"{k},5" for k in range(1, 9))))
    path.write_text(";".join(HEADER) + "\n" + rows)
    with pytest.raises(InputError) as error:
        read_recording(path)
    assert len(error.value.faults) == 1
    assert "numbers have decimal commas" in str(error.value)


@pytest.mark.thorough
def test_white_noise_is_a_misfit_or_a_group_as_seldom_as_is_said() -> None:
    rng = np.random.default_rng(1)
    found = [misfit(rng.standard_normal((4, 30)), np.zeros((0, 30)), 0) for _ in range(2000)]
    assert sum(f is not None and f.is_significant for f in found) <= 10  # 2 are expected
    groups = [odd_group([rng.standard_normal(6)])[1] for _ in range(500)]
    assert sum(map(bool, groups)) <= 5
    assert odd_group([np.array([1.0, 1.01, 3.0, 1.02, 0.99, 1.0])]) == (0, [2])


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "place", "cell"), [("thrust_line", DUTY, "z"), ("thrust_step", DUTY, "z"), ("step", SERVO, "x")]
)
def test_a_shifted_command_of_one_repetition_is_named(
    name: str, place: int, cell: str, good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    checked, identified = answers(good, tmp_path, name, column(place, lambda v: v + 1.0), first_only=True)
    text = (
        f"{COLUMN_NAMES[place]} of {name}0.csv differs from the other repetitions by +1 % in `window` and +1 % at rest"
    )
    assert f"{text}, and volts_{cell} does not: the column is shifted or scaled" in checked
    assert text in identified


COLUMN_NAMES = {DUTY: "duty", SERVO: "servo_duty"}


@pytest.mark.thorough
def test_a_run_of_another_duty_at_one_height_is_named(
    good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    checked, identified = answers(good, tmp_path, "ground_effect", column(DUTY, lambda v: v + 1.0), first_only=True)
    assert "ground_effect0.csv:202:1: duty is 7.3 % in `window`, and 6.1 % in most runs" in checked
    assert len(checked.splitlines()) == 1
    assert identified == checked


@pytest.mark.thorough
def test_a_command_is_named_if_it_is_wrong_and_seldom_if_it_really_differs(tmp_path: Path) -> None:
    protocol = read_protocol(written(tmp_path, short(thrust_line={})))

    def named(change: Callable[[SimulatedRecording], SimulatedRecording], wrong: float = 0.0) -> list[int]:
        sets = [runs_of(protocol, "thrust_line", seed) for seed in range(200)]
        runs = [change(run) if k == 0 else run for each in sets for k, run in enumerate(each)]
        played = play_plain(protocol.bench)(runs)
        counts = []
        for k in range(0, len(played), 3):
            first = replace(played[k], duty=played[k].duty + wrong)
            m = Measurement([first, *played[k + 1 : k + 3]], {}, protocol.bench, protocol.file.tests.thrust_line)
            counts.append(sum("repetition 1" in text for text in odd_commands(m)))
        return counts

    def another(run: SimulatedRecording) -> SimulatedRecording:
        return replace(run, duty=run.duty + 0.1)

    assert sum(named(lambda run: run)) == 0
    assert sum(named(another)) <= 6  # 2 are allowed for, one in a hundred
    assert sum(named(lambda run: run, wrong=1.0)) >= 180


TINY = "and the lowest voltage of the cell's calibration is"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "place"), [("thrust_line", Z), ("step", Z), ("step", X), ("frequency", Z), ("moment", M)]
)
def test_tiny_voltages_are_a_unit_and_not_a_range(
    name: str, place: int, good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    checked, identified = answers(good, tmp_path, name, column(place, lambda v: 1e-300 * v))
    assert checked.count(TINY) == len(checked.splitlines())
    assert "write it in V, or look at the plug" in checked
    assert identified == checked


@pytest.mark.thorough
def test_a_tiny_duty_is_no_share_of_one(good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path) -> None:
    checked, _ = answers(good, tmp_path, "thrust_line", column(DUTY, lambda v: 1e-300 * v))
    assert "duty is 6.6e-300 % at most: the phase with thrust is missing; write the duty in %" in checked


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["thrust_line", "step", "moment"])
def test_a_reading_near_the_largest_number_is_a_spike_without_a_warning_of_numpy(
    name: str, good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path
) -> None:
    checked, identified = answers(good, tmp_path, name, lone(Z, 300, 1e308), first_only=True)
    assert (
        f"{name}0.csv:302:1: volts_z is 1e+308 V here, beyond the converter's 0 to 3.3 V, at 1 reading: a spike"
        in checked
    )
    assert len(checked.splitlines()) == 1
    assert identified == checked


@pytest.mark.thorough
def test_times_too_large_to_be_told_apart_say_so(good: tuple[dict[str, Any], dict[str, Table]], tmp_path: Path) -> None:
    checked, _ = answers(good, tmp_path, "step", column(TIME, lambda v: v + 1e17), first_only=True)
    assert "numbers of this size are 16 s apart in double precision" in checked
    assert "subtract the first time from all times" in checked
