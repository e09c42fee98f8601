"""Logs: what is read is what was measured, and every fault has its place and its cure."""

from __future__ import annotations

import datetime
import math
from pathlib import Path

import numpy as np
import pytest

from cosim.core.errors import InputError
from cosim.core.units import factor
from cosim.files import csv_source
from cosim.logs.gate import gate
from cosim.logs.log import Log, read_log
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


def spreadsheet(path: Path, text: str) -> Path:
    """Write a CSV text as an Excel file."""
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    header, *rows = text.splitlines()
    book.active.append(header.split(","))
    for row in rows:
        time, *cells = row.split(",")
        since = datetime.timedelta(seconds=float(time))
        begin = datetime.datetime(2026, 3, 1, 12)
        book.active.append([begin + since, *map(float, cells)])
    book.save(path)
    return path


PLAIN = HEADER + "\n" + ROWS
TIMED = [line.partition(",") for line in ROWS.splitlines()]


@pytest.mark.parametrize(
    ("text", "count"),
    [
        (PLAIN, 0),
        (PLAIN.replace(",", ";"), 1),
        (PLAIN.replace(",", "\t"), 1),
        (PLAIN.replace(",", "|"), 1),
        ("\ufeff" + PLAIN.replace(",", ";").replace(".", ","), 1),
        (PLAIN.replace(",", "\t").replace(".", ","), 1),
        ("\n".join(";".join(f'"{cell}"' for cell in line.split(",")) for line in PLAIN.replace(".", "·").splitlines())
         .replace("·", ",") + "\n", 1),
        ("," + HEADER + "\n" + "".join(f"{k},{line}\n" for k, line in enumerate(ROWS.splitlines())), 1),
        (HEADER.replace("time", "Zeit [s]") + "\n" + ROWS, 1),
        (HEADER.replace("time", "timestamp [ms]") + "\n" + ROWS.replace("0.02,", "20,").replace("0.04,", "40,"), 1),
        (HEADER.replace("time", "t") + "\n" + ROWS, 1),
        (HEADER.replace("time", "stamp") + "\n" + ROWS, 1),  # the first that increases
        (HEADER + "\n" + "".join(f"2026-03-01T12:00:{t:0>5},{rest}\n" for t, _, rest in TIMED), 1),
        (HEADER + "\n" + "".join(f"01.03.2026 12:00:{t:0>5},{rest}\n" for t, _, rest in TIMED), 1),
        (HEADER + "\n" + "".join(f"2026-03-01 12:00:{t:0>5}+01:00,{rest}\n" for t, _, rest in TIMED), 1),
    ],
)  # fmt: skip
def test_logs_are_read_as_people_have_them(tmp_path: Path, text: str, count: int) -> None:
    wanted, log = read(tmp_path / "plain.csv", PLAIN), read(tmp_path / "a.csv", text)
    assert log.time.tolist() == pytest.approx(wanted.time.tolist(), abs=1e-9)
    for name in wanted.inputs:
        assert log.inputs[name].tolist() == wanted.inputs[name].tolist()
    for name in wanted.outputs:
        assert log.outputs[name].tolist() == wanted.outputs[name].tolist()
    assert len(log.assumed) == count
    assert sum(f.kind == "assumed" for f in gate(log)) == count


def test_a_sheet_of_excel_is_a_log_and_several_tables_are_refused(tmp_path: Path) -> None:
    wanted = read(tmp_path / "plain.csv", PLAIN)
    path = spreadsheet(tmp_path / "a.xlsx", PLAIN)
    log = read_log(path, INPUTS, OUTPUTS)
    assert log.time.tolist() == pytest.approx(wanted.time.tolist(), abs=1e-6)
    assert log.outputs["psi"].tolist() == wanted.outputs["psi"].tolist()
    assert len(log.assumed) == 1
    openpyxl = pytest.importorskip("openpyxl")
    for several in ("sheet", "below"):
        book = openpyxl.load_workbook(path)
        if several == "sheet":
            book.create_sheet("other").append(["x"])
        else:
            book.active["A8"] = "x"
        book.save(tmp_path / f"{several}.xlsx")
        with pytest.raises(InputError):
            read_log(tmp_path / f"{several}.xlsx", INPUTS, OUTPUTS)
    (tmp_path / "torn.xlsx").write_bytes(path.read_bytes()[:900])
    with pytest.raises(InputError):
        read_log(tmp_path / "torn.xlsx", INPUTS, OUTPUTS)


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("", ":1:1"),
        ("\r\n , \n\n", ":1:1"),
        ("\n\n" + HEADER.replace("tilt_left", "tilt_lef") + "\n" + ROWS, ":3:5"),
        (HEADER + "\n", ":2:1"),
        (HEADER + "\n" + ROWS.splitlines()[0], ":2:1"),
        (HEADER.replace(",tilt_left", "") + "\n0,6,6,0,0,0\n1,6,6,0,0,0\n", ":1:1"),
        (HEADER.replace("psi,psi_dot", "spsi,psidot") + "\n" + ROWS, ":1:1"),
        (HEADER.replace("psi_dot", "psi") + "\n" + ROWS, ":1:7"),
        (HEADER.replace("time", "tiem") + "\n" + ROWS.replace("0.04,", "0.01,"), ":1:1"),
        (HEADER.replace("time", "x") + "\n0,1,6,0,0,0,0\n0,2,6,0,0,0,0\n0,3,6,0,0,0,0\n", ":1:1"),  # an input increases
        (HEADER.replace("time", "t").replace("psi,", "zeit,") + "\n" + ROWS, ":1:6"),
        (HEADER.replace("psi_dot", "psi_dot [m]") + "\n" + ROWS, ":1:7"),
        (HEADER.replace("time", "time [V]") + "\n" + ROWS, ":1:1"),
        (HEADER + "\n" + ROWS.replace("0.04,", "0.02,"), ":4:1"),
        (HEADER + "\n" + ROWS.replace("0.04,", ","), ":4:1"),
        (HEADER + "\n" + ROWS.replace("0.2,0.1,0.1", "x,0.1,0.1"), ":4:4"),
        (HEADER + "\n" + ROWS.replace("0.2,0.1,0.1", "nan,0.1,0.1"), ":4:4"),
        (HEADER + "\n" + ROWS.replace("0.2,0.1,0.1", "inf,0.1,0.1"), ":4:4"),
        (HEADER + "\n" + ROWS + "0.06,6.4,6.4\n", ":5:1"),
        (HEADER + "\n" + ROWS + "0,06,6,4,6,4,0,1,0,1,0,1,0,2\n", ":5:1"),
        (HEADER + "\n" + ROWS.replace("0.2,0.1,0.1", '"0,2",0.1,0.1'), ":4:4"),
        (HEADER + "\n" + ROWS + "0.06,6.4,6.4,0.1,0.1,1e300,0\n", ":5:6"),
        (HEADER + "\n" + ROWS + "0.06,6.4,6.4,0.1,0.1,-3.4e38,0\n", ":5:6"),
        (HEADER + "\n" + ROWS + "0.06,1e20,6.4,0.1,0.1,0,0\n", ":5:2"),
        (HEADER + "\n" + ROWS + "1e300,6.4,6.4,0.1,0.1,0,0\n", ":5:1"),
        (HEADER + "\n0,6,6,0,0,1,nan\n0.1,6,6,0,0,1,\n", ":1:7"),
        (HEADER.replace(",psi,psi_dot", "") + "\n0,6,6,0,0\n1,6,6,0,0\n", ":1:1"),
        ((HEADER + "\n" + ROWS + "1.000,06,6,6,0,0,0,0\n").replace(",", ";").replace("1.000;06", "1.000,06"), ":5:1"),
        ((HEADER + "\n" + ROWS).replace(",", ";").replace("0.02;", "0.02,"), ":3:1"),
        ((HEADER + "\n" + ROWS).replace(",", "  "), ":1:1"),
        ((HEADER + "\n" + ROWS).encode("utf-16"), ":1:1"),
        ((HEADER + "\n" + ROWS).encode() + b"0.06,6,6,0,0,\xff,0\n", ":5:1"),
    ],
)  # fmt: skip
def test_a_fault_is_told_with_its_place(tmp_path: Path, text: str | bytes, place: str) -> None:
    (told,) = faults(tmp_path / "a.csv", text)
    assert told.startswith(f"{place}: ")


def test_all_faults_are_told_at_once(tmp_path: Path) -> None:
    text = HEADER.replace("psi,", "psy,").replace("duty_left", "duty_lft") + "\n" + ROWS.replace("0.02,", "0,", 1)
    told = faults(tmp_path / "a.csv", text + "0.06,6,6,0,0,0,-\n")
    # duty_left is written duty_lft, a time stands still, a cell is no number; psy is not read, which is no fault
    assert [t.split(":")[1:3] for t in told] == [["1", "3"], ["3", "1"], ["5", "7"]]


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


def test_a_gigabyte_is_refused_before_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "big.csv"
    with path.open("wb") as stream:
        stream.truncate(1_000_000_000)  # sparse: takes no room

    monkeypatch.setattr(csv_source, "open_bytes", lambda path: pytest.fail("it was opened"))
    with pytest.raises(InputError, match=r"1000 MB, more than the 200 MB .* pieces"):
        read_log(path, INPUTS, OUTPUTS)


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
