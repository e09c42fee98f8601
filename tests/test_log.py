"""Logs: what is read is what was measured, and every fault has its place and its cure."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path

import numpy as np
import pytest

from cosim.base.errors import InputError
from cosim.base.units import alternatives, factor
from cosim.logs.gate import gate
from cosim.logs.log import Log, read_column_names, read_log
from cosim.model.traits import rate_of
from cosim.residuals.drive import model_signals
from cosim.storage import csv_source
from cosim.storage.table import SHOWN_FAULTS, split_heading
from plant.hovercraft import INPUTS, OUTPUTS
from tests.logs import MOVING, fly, measured, times, write_log

RECORDED = Path(__file__).parent / "data" / "hovercraft_10s.csv"
HEADER = "time,duty_right,duty_left,tilt_right,tilt_left,psi,psi_dot"
ROWS = "0.00,6.4,6.4,0.1,0.1,0.0,0.0\n0.02,6.4,6.4,0.1,0.1,0.1,0.0\n0.04,6.4,6.4,0.2,0.1,0.1,0.0\n"


def read(path: Path, text: str | bytes) -> Log:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_log(path, INPUTS, OUTPUTS)


def faults(path: Path, text: str | bytes) -> list[str]:
    with pytest.raises(InputError) as refused:
        read(path, text)
    assert refused.value.exit_code == 2
    return [str(f).removeprefix(str(path)) for f in refused.value.faults]


def test_a_recorded_log_is_read_as_it_stands() -> None:
    log = read_log(RECORDED, INPUTS, OUTPUTS)
    table = np.loadtxt(RECORDED, delimiter=",", skiprows=1)
    columns = {"time": log.time, **log.inputs, **log.outputs}
    for k, name in enumerate(RECORDED.read_text().splitlines()[0].split(",")):
        assert columns[name].tolist() == table[:, k].tolist()
    assert (log.rows, log.step) == (501, 0.02)
    assert (log.units["psi"], log.units["tilt_left"], log.units["ax"]) == ("rad", "rad", "m/s2")


def test_the_log_of_the_document_is_one(tmp_path: Path) -> None:
    page = (Path(__file__).parent.parent / "docs" / "logs.md").read_text(encoding="utf-8")
    block = re.search(r"```csv\n(.*?)```", page, re.DOTALL)
    assert block is not None
    log = read(tmp_path / "a.csv", block[1])
    assert (log.rows, log.step) == (2, 0.02)
    assert log.outputs["psi"][0] == pytest.approx(math.radians(12.5), rel=1e-15)
    assert np.isnan(log.outputs["x_world"]).tolist() == [False, True]


def test_an_fmu_and_its_equations_name_the_same_signals(plant_fmu: Path) -> None:
    by_fmu, by_model = read_log(RECORDED, *model_signals(plant_fmu)), read_log(RECORDED, INPUTS, OUTPUTS)
    assert dict(by_fmu.units) == dict(by_model.units)
    assert list(by_fmu.outputs) == list(by_model.outputs)


@pytest.mark.parametrize(
    ("written", "wanted", "value"),
    [
        ("deg", "rad", math.pi / 180),
        ("°/s", "rad/s", math.pi / 180),
        ("mm", "m", 1e-3),
        ("m/s^2", "m/s2", 1.0),
        ("m·s⁻²", "m/s2", 1.0),
        ("g", "m/s2", 9.80665),  # of an accelerometer; standard gravity
        ("km/h", "m/s", 1 / 3.6),
        ("rpm", "rad/s", math.pi / 30),
        ("gf", "N", 0.00980665),
        ("ms", "s", 1e-3),
        ("N.mm", "N.m", 1e-3),
        ("rad", "", 1.0),  # a model without units takes what it is given
    ],
)
def test_units_are_converted(written: str, wanted: str, value: float) -> None:
    assert factor(written, wanted) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    ("written", "wanted"), [("m", "rad"), ("furlong", "m"), ("deg", "rad/s"), ("m/", "m"), ("kg", "N")]
)
def test_units_that_do_not_fit_are_refused(written: str, wanted: str) -> None:
    assert factor(written, wanted) is None


def test_what_is_offered_in_place_of_a_unit_can_be_converted() -> None:
    assert {"m/s2", "mm/s2"} <= set(alternatives("m/s2"))
    assert all(factor(unit, "rad/s") for unit in alternatives("rad/s"))


def test_degrees_and_milliseconds_become_radians_and_seconds(tmp_path: Path) -> None:
    header = "time [ms], duty_right, duty_left, tilt_right [deg], tilt_left [deg], psi [deg], psi_dot [deg/s]"
    log = read(tmp_path / "a.csv", f"{header}\n0,6.4,6.4,9,9,90,-180\n20,6.4,6.4,9,9,91,-180\n")
    assert log.time.tolist() == [0.0, 0.02]
    assert log.outputs["psi"][0] == pytest.approx(math.pi / 2, rel=1e-15)
    assert log.outputs["psi_dot"][0] == pytest.approx(-math.pi, rel=1e-15)
    assert log.inputs["tilt_right"][0] == pytest.approx(math.pi / 20, rel=1e-15)


def test_a_heading_that_was_wrapped_is_continuous_again(tmp_path: Path) -> None:
    flight = fly(times(8.0), start={**MOVING, "psi": 3.0, "psi_dot": 0.4})
    columns = measured(flight, ("psi",), noise=1.0)
    whole = columns["psi"]
    columns["psi"] = np.mod(whole + math.pi, 2.0 * math.pi) - math.pi
    assert np.abs(np.diff(columns["psi"])).max() > 6.0  # it did cross ±π
    columns["psi"][100:110] = np.nan
    log = read_log(write_log(tmp_path / "a.csv", columns), INPUTS, OUTPUTS)
    turns = (log.outputs["psi"] - whole)[np.isfinite(columns["psi"])]
    assert turns == pytest.approx(np.full(turns.size, turns[0]), abs=1e-12)  # rounding of 2π sums
    assert log.unwrapped["psi"]


def test_an_angle_that_turns_on_is_left_alone(tmp_path: Path) -> None:
    flight = fly(times(2.0))
    columns = measured(flight, ("psi",)) | {"psi": 4.0 * np.arange(flight.time.size)}  # a fast shaft: 4 rad a row
    log = read_log(write_log(tmp_path / "a.csv", columns), INPUTS, OUTPUTS)
    assert log.outputs["psi"].tolist() == columns["psi"].tolist()
    assert not log.unwrapped


def test_cells_may_be_empty_where_nothing_was_measured(tmp_path: Path) -> None:
    log = read(tmp_path / "a.csv", f"{HEADER}\n0,6,6,0,0,,NaN\n0.1,6,6,0,0,1.5,\n0.2,6,6,0,0, ,2\n")
    assert np.isnan(log.outputs["psi"]).tolist() == [True, False, True]
    assert log.outputs["psi_dot"][2] == 2.0


def test_the_way_a_program_ends_its_lines_does_not_matter(tmp_path: Path) -> None:
    plain, windows = (
        HEADER + "\n" + ROWS,
        b"\xef\xbb\xbf" + (HEADER + "\n" + ROWS + "\n").replace("\n", "\r\n").encode(),
    )
    a, b = read(tmp_path / "a.csv", plain), read(tmp_path / "b.csv", windows)
    assert a.outputs["psi"].tolist() == b.outputs["psi"].tolist()


@pytest.mark.parametrize(
    ("text", "place", "words"),
    [
        ("", ":1:1", "is empty"),
        ("\r\n , \n\n", ":1:1", "is empty"),
        ("\n\n" + HEADER.replace("tilt_left", "tilt_lef") + "\n" + ROWS, ":3:5", 'did you mean "tilt_left", which'),
        (HEADER + "\n", ":2:1", "no row"),
        (HEADER + "\n" + ROWS.splitlines()[0], ":2:1", "one row"),
        (HEADER.replace(",tilt_left", "") + "\n0,6,6,0,0,0\n1,6,6,0,0,0\n", ":1:1", 'input "tilt_left" is missing'),
        (HEADER.replace("psi,psi_dot", "spsi,psidot") + "\n" + ROWS, ":1:1", 'did you mean "psi_dot"?'),
        (HEADER.replace("psi_dot", "psi") + "\n" + ROWS, ":1:7", "stands twice"),
        (HEADER.replace("time", "tiem") + "\n" + ROWS, ":1:1", 'did you mean "time"?'),
        (HEADER.replace("psi_dot", "psi_dot [m]") + "\n" + ROWS, ":1:7", "known here: rad/s, deg/s"),
        (HEADER.replace("time", "time [V]") + "\n" + ROWS, ":1:1", "ms"),
        (HEADER + "\n" + ROWS.replace("0.04,", "0.02,"), ":4:1", "does not increase"),
        (HEADER + "\n" + ROWS.replace("0.04,", ","), ":4:1", "time has no value here"),
        (HEADER + "\n" + ROWS.replace("0.2,0.1,0.1", "x,0.1,0.1"), ":4:4", '"x" in column tilt_right is no number'),
        (HEADER + "\n" + ROWS.replace("0.2,0.1,0.1", "nan,0.1,0.1"), ":4:4", "an input is known at every row"),
        (HEADER + "\n" + ROWS.replace("0.2,0.1,0.1", "inf,0.1,0.1"), ":4:4", "is not finite"),
        (HEADER + "\n" + ROWS + "0.06,6.4,6.4\n", ":5:1", "has 3 cells, the header 7"),
        (HEADER + "\n" + ROWS + "0,06,6,4,6,4,0,1,0,1,0,1,0,2\n", ":5:1", "decimal comma? Write a point"),
        (HEADER + "\n" + ROWS.replace("0.2,0.1,0.1", '"0,2",0.1,0.1'), ":4:4", "has a decimal comma: write a point"),
        (HEADER + "\n" + ROWS + "0.06,6.4,6.4,0.1,0.1,1e300,0\n", ":5:6", "psi is 1e+300 here, far beyond the rest"),
        (HEADER + "\n" + ROWS + "0.06,6.4,6.4,0.1,0.1,-3.4e38,0\n", ":5:6", "leave the cell empty"),
        (HEADER + "\n" + ROWS + "0.06,1e20,6.4,0.1,0.1,0,0\n", ":5:2", "leave the row out"),
        (HEADER + "\n" + ROWS + "1e300,6.4,6.4,0.1,0.1,0,0\n", ":5:1", "leave the row out"),
        (HEADER + "\n0,6,6,0,0,1,nan\n0.1,6,6,0,0,1,\n", ":1:7", "holds no value"),
        (HEADER.replace(",psi,psi_dot", "") + "\n0,6,6,0,0\n1,6,6,0,0\n", ":1:1", "holds no output of the model"),
        ((HEADER + "\n" + ROWS).replace(",", ";"), ":1:1", "separate them with commas"),
        ((HEADER + "\n" + ROWS).encode("utf-16"), ":1:1", "not UTF-8"),
        ((HEADER + "\n" + ROWS).encode() + b"0.06,6,6,0,0,\xff,0\n", ":5:1", "not UTF-8"),
    ],
)  # fmt: skip
def test_a_fault_is_told_with_its_place_and_cure(tmp_path: Path, text: str | bytes, place: str, words: str) -> None:
    (told,) = faults(tmp_path / "a.csv", text)
    assert told.startswith(f"{place}: ")
    assert words in told


def test_all_faults_are_told_at_once(tmp_path: Path) -> None:
    text = HEADER.replace("psi,", "psy,").replace("duty_left", "duty_lft") + "\n" + ROWS.replace("0.02,", "0,", 1)
    told = faults(tmp_path / "a.csv", text + "0.06,6,6,0,0,0,-\n")
    # duty_left is written duty_lft, a time stands still, a cell is no number; psy is not read, which is no fault
    assert [t.split(":")[1:3] for t in told] == [["1", "3"], ["3", "1"], ["5", "7"]]


def test_columns_that_the_model_does_not_have_are_not_read_which_is_noted(tmp_path: Path) -> None:
    rows = "".join(f"{0.02 * k:.2f},6.4,6.4,0.1,0.1,0.1,0.2,x,,9\n" for k in range(3))
    log = read(tmp_path / "a.csv", HEADER + ",plant.psi_dt,,battery [V]\n" + rows)
    assert list(log.outputs) == ["psi", "psi_dot"]
    assert list(log.unread) == ["plant.psi_dt", "", "battery"]
    found = {f.severity: f.whole for f in gate(log, None) if f.kind == "unread"}
    assert (
        found["note"]
        == "3 columns not read, for the model has none of this name: plant.psi_dt, one without a name, battery"
    )
    close = read(tmp_path / "b.csv", HEADER.replace("psi_dot", "psi_dt") + "\n" + ROWS)
    (warning,) = (f.line for f in gate(close, None) if f.kind == "unread")
    assert warning == 'warning: psi_dt is not read: the model has none of this name; did you mean "psi_dot"?'


def test_columns_may_be_mapped_to_names_of_the_model(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(HEADER.replace("psi_dot", "gyro [z] [deg/s]").replace("duty_left", "left") + "\n" + ROWS)
    columns = {"gyro [z]": "psi_dot", "left": "duty_left"}
    log = read_log(path, INPUTS, OUTPUTS, columns=columns)
    assert log.outputs["psi_dot"] == pytest.approx(
        math.radians(1.0) * read(tmp_path / "b.csv", HEADER + "\n" + ROWS).outputs["psi_dot"]
    )
    for wrong, words in (
        ({"lef": "duty_left"}, 'has no column "lef"; did you mean "left"? (it is to be duty_left)'),
        ({"left": "duty_lft"}, '"left" is to be duty_lft, which the model does not have; did you mean "duty_left"?'),
        ({"left": "duty_right"}, "keep one"),
    ):
        with pytest.raises(InputError) as refused:
            read_log(path, INPUTS, OUTPUTS, columns=wrong)
        assert words in str(refused.value)


def test_texts_of_columns_are_a_column_and_a_variable(tmp_path: Path) -> None:
    assert read_column_names(["left = duty_left", "t=time"], tmp_path) == {"left": "duty_left", "t": "time"}
    wrong = ["left", "=duty_left", "left=", " = ", "="]
    with pytest.raises(InputError) as refused:
        read_column_names(["t=time", *wrong], tmp_path)
    assert {f.message for f in refused.value.faults} == {
        f'--column "{text}" is not COLUMN=VARIABLE, as in measured_speed=motor.w' for text in wrong
    }


@pytest.mark.parametrize(
    ("text", "names", "name", "unit"),
    [
        ("ax [m/s2]", (), "ax", "m/s2"),
        ("psi[deg]", (), "psi", "deg"),
        ("p_Crane.e[1]", (), "p_Crane.e[1]", ""),
        ("p_Crane.e[1] [N]", (), "p_Crane.e[1]", "N"),
        ("m[1, 2]", (), "m[1, 2]", ""),
        ("share[1]", ("share",), "share", "1"),
        ("share [1]", (), "share", "1"),
        ("a b [kg]", ("a b [kg]",), "a b [kg]", ""),
        ("der(x[1]) it's", (), "der(x[1]) it's", ""),
        ("time [s", (), "time", "s"),
    ],
)  # fmt: skip
def test_brackets_of_a_name_are_told_from_those_of_a_unit(
    text: str, names: tuple[str, ...], name: str, unit: str
) -> None:
    assert split_heading(text, names) == (name, unit)


def test_thousands_of_faulty_cells_are_counted_not_listed(tmp_path: Path) -> None:
    rows = "".join(f"{k},6,6,0,0,off,0\n" for k in range(5000))
    told = faults(tmp_path / "a.csv", HEADER + "\n" + rows)
    assert len(told) == SHOWN_FAULTS + 1
    assert "4995 more" in told[0]
    assert [t.split(":")[1:3] for t in told[1:]] == [[str(line), "6"] for line in range(2, 7)]


def test_times_that_are_no_numbers_say_nothing_of_the_other_columns(tmp_path: Path) -> None:
    told = faults(tmp_path / "a.csv", HEADER + "\n" + '"0,00",6,6,0,0,0,0\n"0,02",6,6,0,0,0,0\n')
    assert [t.split(":")[1:3] for t in told] == [["2", "1"], ["3", "1"]]


def test_a_pulse_on_a_command_that_rests_is_a_command(tmp_path: Path) -> None:
    rows = "".join(f"{0.02 * k},{5e6 if k == 50 else 0.0},6.4,0.1,0.1,{1e-17 * k},0.0\n" for k in range(100))
    assert read(tmp_path / "a.csv", f"{HEADER}\n{rows}").inputs["duty_right"].max() == 5e6


def test_a_gigabyte_is_refused_before_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "big.csv"
    with path.open("wb") as stream:
        stream.truncate(1_000_000_000)  # sparse: takes no room

    monkeypatch.setattr(csv_source, "open_bytes", lambda path: pytest.fail("it was opened"))
    with pytest.raises(InputError, match=r"1000 MB, more than the 200 MB .* pieces"):
        read_log(path, INPUTS, OUTPUTS)


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.csv")
    with pytest.raises(InputError, match="is no file"):
        read_log(tmp_path / "a.csv", INPUTS, OUTPUTS)


@pytest.mark.parametrize(
    ("name", "words"), [("a\0b.csv", "no such file"), ("none.csv", "no such file"), (".", "is no file")]
)
def test_what_is_not_there_is_said_to_be_missing(tmp_path: Path, name: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        read_log(tmp_path / name, INPUTS, OUTPUTS)


def test_rates_are_found_by_their_names() -> None:
    known = {"psi", "psi_dot", "x", "vx", "position", "velocity", "angle"}
    pairs = {name: rate_of(name, known) for name in sorted(known)}
    assert {a: b for a, b in pairs.items() if b} == {"psi": "psi_dot", "x": "vx", "position": "velocity"}


@pytest.mark.parametrize(
    ("time", "grid"),
    [
        ([0.0, 1.0, 2.0, 3.0], [0, 1, 2, 3]),
        ([5.0, 6.0, 8.0, 9.0, 10.0, 13.0], [0, 1, 3, 4, 5, 8]),
        ([0.0, 0.9, 2.1, 4.9, 6.0, 7.0, 8.0], [0, 1, 2, 5, 6, 7, 8]),
        ([0.0, 1.0, 2.6, 3.0, 4.0, 6.0, 7.0], [0, 1, 2, 3, 4, 6, 7]),
        ([0.0, 1.02, 2.04, 3.06, 4.08, 5.1], [0, 1, 2, 3, 4, 5]),
    ],
    ids=["whole", "rows missing", "jitter", "one row late", "none missing"],
)
def test_rows_stand_in_equal_steps_with_room_for_those_that_are_missing(
    tmp_path: Path, time: list[float], grid: list[int]
) -> None:
    rows = "".join(f"{t},6.4,6.4,0.1,0.1,{0.01 * t},0.0\n" for t in time)
    assert read(tmp_path / "a.csv", f"{HEADER}\n{rows}").grid.tolist() == grid
