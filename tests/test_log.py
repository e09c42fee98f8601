"""Reading of logs: values as measured, and faults with place and cure."""

from __future__ import annotations

import datetime
import math
import re
from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.core.errors import InputError
from cosim.files import csv_source
from cosim.logs.gate import gate
from cosim.logs.log import Log, read_log
from plant.hovercraft import INPUTS, OUTPUTS
from tests.logs import RECORDED, times, write_log
from tests.test_first_steps import told

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
    log, table = read_log(RECORDED, INPUTS, OUTPUTS), np.genfromtxt(RECORDED, delimiter=",", names=True)
    for name, values in ({"time": log.time} | log.inputs | log.outputs).items():
        np.testing.assert_array_equal(values, table[name])
    assert (log.rows, log.step) == (501, 0.02)
    assert (log.units["psi"], log.units["ax"]) == ("rad", "m/s2")


def test_a_heading_that_was_wrapped_is_continuous_again(tmp_path: Path) -> None:
    time = times(8.0)
    whole = 3.0 + 0.4 * time + 0.01 * np.random.default_rng(7).standard_normal(time.size)
    commands = dict.fromkeys((q.name for q in INPUTS), 0.0 * time)
    psi = np.mod(whole + math.pi, 2.0 * math.pi) - math.pi
    psi[100:110] = np.nan
    log = read_log(write_log(tmp_path / "a.csv", {"time": time, **commands, "psi": psi}), INPUTS, OUTPUTS)
    turns = (log.outputs["psi"] - whole)[np.isfinite(psi)]
    assert turns == pytest.approx(np.full(turns.size, turns[0]), abs=1e-12)  # rounding of 2π sums
    assert log.unwrapped["psi"]


PLAIN = HEADER + "\n" + ROWS
SEMICOLONS = PLAIN.replace(",", ";")


@pytest.mark.parametrize(
    ("text", "count"),
    [
        (PLAIN.replace("\n", "\r\n").encode("utf-8-sig"), 0),
        (SEMICOLONS, 1),
        (PLAIN.replace(",", "\t"), 1),
        ("\ufeff" + SEMICOLONS.replace(".", ","), 1),
        (re.sub(r"[^;\n]+", r'"\g<0>"', SEMICOLONS.replace(".", ",")), 1),
        (
            PLAIN.replace("time", ",time")
            .replace("0.02,", "1,0.02,")
            .replace("0.04,", "2,0.04,")
            .replace("0.00,", "0,0,"),
            1,
        ),
        (PLAIN.replace("time", "timestamp [ms]").replace("0.02,", "20,").replace("0.04,", "40,"), 1),
        (PLAIN.replace("time", "stamp"), 1),  # the first that increases
        (re.sub(r"^0", "01.03.2026 12:00:00", PLAIN, flags=re.MULTILINE), 1),
        (re.sub(r"^(0.0\d)", r"2026-03-01 12:00:0\1+01:00", PLAIN, flags=re.MULTILINE), 1),
    ],
)
def test_logs_are_read_as_people_have_them(tmp_path: Path, text: str | bytes, count: int) -> None:
    wanted, log = read(tmp_path / "plain.csv", PLAIN), read(tmp_path / "a.csv", text)
    assert log.time.tolist() == pytest.approx(wanted.time.tolist(), abs=1e-9)
    for name, values in (wanted.inputs | wanted.outputs).items():
        assert (log.inputs | log.outputs)[name].tolist() == values.tolist()
    assert len(log.assumed) == sum(f.kind == "assumed" for f in gate(log)) == count


@pytest.mark.parametrize("number", ["1.234,5", "-1 234 567,5", "1'234.5", "1,234.5"])
def test_numbers_with_a_separator_of_thousands_are_refused_with_their_place(tmp_path: Path, number: str) -> None:
    (tmp_path / "a.csv").write_text(f"time;speed\n0;1\n0,1;{number}\n")
    with pytest.raises(InputError) as refused:
        cosim.check(tmp_path / "a.csv")
    assert [(f.line, f.column) for f in refused.value.faults] == [(3, 2)]


def test_a_sheet_of_excel_is_a_log_and_several_tables_are_refused(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    wanted, path, book = read(tmp_path / "plain.csv", PLAIN), tmp_path / "a.xlsx", openpyxl.Workbook()
    book.active.append(HEADER.split(","))
    for row in ROWS.splitlines():
        time, *cells = map(float, row.split(","))
        book.active.append([datetime.datetime(2026, 3, 1, 12) + datetime.timedelta(seconds=time), *cells])
    book.save(path)
    log = read_log(path, INPUTS, OUTPUTS)
    assert log.time.tolist() == pytest.approx(wanted.time.tolist(), abs=1e-6)
    assert log.outputs["psi"].tolist() == wanted.outputs["psi"].tolist()
    assert len(log.assumed) == 1
    told("check", path)
    (tmp_path / "torn.xlsx").write_bytes(path.read_bytes()[:900])
    book.create_sheet("other").append(["x"])
    book.save(path)
    for refused in (path, tmp_path / "torn.xlsx"):
        with pytest.raises(InputError):
            read_log(refused, INPUTS, OUTPUTS)


def test_a_measurement_file_is_a_log_whose_channels_have_times_of_their_own(tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    wanted, path = read(tmp_path / "plain.csv", PLAIN), tmp_path / "a.mf4"
    table = np.genfromtxt((tmp_path / "plain.csv"), delimiter=",", names=True)
    names = HEADER.split(",")[1:]
    slow = asammdf.Signal(table["psi"][::2], table["time"][::2], name="psi", unit="rad")
    command = asammdf.Signal(table[names[0]][:1], table["time"][:1], name=names[0])  # the first row's, and held
    others = [asammdf.Signal(table[name], table["time"], name=name) for name in names[1:] if name != "psi"]
    with asammdf.MDF(version="4.10") as file:
        for signals in ([command], others, [slow]):
            file.append(signals)
        file.save(path)
    log = read_log(path, INPUTS, OUTPUTS)
    assert log.time.tolist() == wanted.time.tolist()
    assert set(log.inputs[names[0]]) == {wanted.inputs[names[0]][0]}
    assert np.isnan(log.outputs["psi"]).tolist() == [k % 2 == 1 for k in range(log.time.size)]
    assert log.outputs["psi"][::2].tolist() == wanted.outputs["psi"][::2].tolist()
    assert len(log.assumed) == 1
    path.write_bytes(path.read_bytes()[:700])
    with pytest.raises(InputError):
        read_log(path, INPUTS, OUTPUTS)


LAST = "0.04,6.4,6.4,0.2,0.1,0.1,0.0"


REPLACED = (
    (PLAIN, "", ":1:1"),
    ("tilt_left", "tilt_lef", ":1:5"),
    (ROWS, "", ":2:1"),
    ("psi_dot", "psi", ":1:7"),
    ("psi_dot", "psi_dot [m]", ":1:7"),
    ("0.04,", "0.02,", ":4:1"),
    ("0.04,", ",", ":4:1"),
    ("0.2,", "x,", ":4:4"),
    ("0.2,", "inf,", ":4:4"),
    ("0.2,", '"0,2",', ":4:4"),
    (LAST, "0.04,6.4,6.4", ":4:1"),
    (LAST, "0,04,6,4,6,4,0,2,0,1,0,1,0,0", ":4:1"),
    (LAST, "0.04,6.4,6.4,0.1,0.1,1e300,0", ":4:6"),
    ("0.04,", "1e300,", ":4:1"),
    (",0.0\n", ",\n", ":1:7"),
    (",", "  ", ":1:1"),
)


@pytest.mark.parametrize(
    ("text", "place"),
    [
        *((PLAIN.replace(old, new), place) for old, new, place in REPLACED),
        ("\n\n" + PLAIN.replace("tilt_left", "tilt_lef"), ":3:5"),
        (PLAIN.replace("time", "tiem").replace("0.04,", "0.01,"), ":1:1"),
        (HEADER.replace("time", "x") + "\n0,1,6,0,0,0,0\n0,2,6,0,0,0,0\n0,3,6,0,0,0,0\n", ":1:1"),  # an input increases
        (PLAIN.replace("time", "t").replace("psi,", "zeit,"), ":1:6"),
        (SEMICOLONS.replace("0.02;", "0.02,"), ":3:1"),
        (SEMICOLONS.replace("0.04;", "1.000,06;"), ":4:1"),
        (PLAIN.encode("utf-16"), ":1:1"),
        (PLAIN.encode() + b"0.06,6,6,0,0,\xff,0\n", ":5:1"),
    ],
)
def test_a_fault_is_told_with_its_place(tmp_path: Path, text: str | bytes, place: str) -> None:
    (fault,) = faults(tmp_path / "a.csv", text)
    assert fault.startswith(f"{place}: ")


def test_all_faults_are_told_at_once(tmp_path: Path) -> None:
    text = HEADER.replace("psi,", "psy,").replace("duty_left", "duty_lft") + "\n" + ROWS.replace("0.02,", "0,", 1)
    told = faults(tmp_path / "a.csv", text + "0.06,6,6,0,0,0,-\n")
    # duty_left is written duty_lft, a time stands still, a cell is no number; psy is not read, which is no fault
    assert [t.split(":")[1:3] for t in told] == [["1", "3"], ["3", "1"], ["5", "7"]]


def test_columns_may_be_mapped_to_names_of_the_model(tmp_path: Path) -> None:
    path, plain = tmp_path / "a.csv", read(tmp_path / "b.csv", PLAIN)
    path.write_text(PLAIN.replace("psi_dot", "gyro [z] [deg/s]").replace("duty_left", "left"))
    log = read_log(path, INPUTS, OUTPUTS, columns={"gyro [z]": "psi_dot", "left": "duty_left"})
    assert log.outputs["psi_dot"] == pytest.approx(math.radians(1.0) * plain.outputs["psi_dot"])
    for wrong in ({"lef": "duty_left"}, {"left": "duty_lft"}, {"left": "duty_right"}):
        with pytest.raises(InputError):
            read_log(path, INPUTS, OUTPUTS, columns=wrong)


def test_a_gigabyte_is_refused_before_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "big.csv"
    with path.open("wb") as stream:
        stream.truncate(1_000_000_000)  # sparse: takes no room

    monkeypatch.setattr(csv_source, "open_bytes", lambda path: pytest.fail("it was opened"))
    with pytest.raises(InputError):
        read_log(path, INPUTS, OUTPUTS)


def test_an_input_is_constant_only_if_it_never_moves(tmp_path: Path) -> None:
    time = 0.02 * np.arange(600)
    inputs = {**{q.name: np.zeros(600) for q in INPUTS}, "duty_right": 1.0 * (time > 6.0)}
    path = write_log(tmp_path / "a.csv", {"time": time, **inputs, "psi": np.sin(time)})
    findings = gate(read_log(path, INPUTS, OUTPUTS))
    assert {f.channel for f in findings if f.kind == "constant"} == {q.name for q in INPUTS} - {"duty_right"}


# -- without a model ----------------------------------------------------------------------------------


def test_a_log_of_no_model_is_checked_by_itself(tmp_path: Path) -> None:
    rows = [f"{0.02 * k},{math.sin(k / 9)},5,RUN,{k * k % 17}" for k in range(600) if not 200 < k < 240]
    (tmp_path / "mylog.csv").write_text("\n".join(["time,T [degC],still [V],mode,odd [furlong]", *rows, ""]))
    told = "\n".join(cosim.check(tmp_path / "mylog.csv"))
    assert "39 rows missing in 1 place, first after t = 4 s, the longest 0.800" in told
    assert "still is constant at 5.00" in told
    assert "furlong" in told


@pytest.mark.parametrize(
    ("text", "model", "place"),
    [
        ("time,duty_right,x\n0,6,0\n1,6,1\n", "", 'input "duty_left" is missing'),  # has an input of base
        ("time,u,x\n0,6,0\n1,6,1\n", "base", r"input .duty_right. is missing"),
        ("time\n0\n1\n", "", "a.csv:1:1"),
        ("time,,x\n0,1,2\n1,1,3\n", "", "a.csv:1:2"),
        ("0,1,2\n1,2,3\n2,3,4\n", "", "no header"),
        ("time,u\n0,6_3\n1,2\n", "", "a.csv:2:2"),
    ],
)
def test_a_table_that_is_no_log_is_refused(text: str, model: str, place: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=place):
        cosim.check(tmp_path / "a.csv", *([model] if model else []))
