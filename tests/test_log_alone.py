"""A log without a model, all its faults at once, line ends of any kind, and numbers beyond what a double can square."""

from __future__ import annotations

import math
import re
import warnings
from pathlib import Path

import pytest

import cosim
from cosim.base.errors import InputError
from cosim.logs import log_check
from cosim.storage.table import read_columns, read_header
from tests.test_first_steps import told as asked
from tests.typed import typed_fmu

ROWS = "".join(
    f"{k * 0.02:.2f},{20 + math.sin(k / 9)},{90 * math.sin(k / 7)},5,RUN,{k * k % 17}\n"
    for k in range(600)
    if not 200 < k < 240
)
FAULTY = "t;drive;seen [furlong]\n0;1,5;a\n1;2;3\n"


def test_a_log_of_no_model_is_checked_by_itself(tmp_path: Path) -> None:
    path = tmp_path / "mylog.csv"
    path.write_text(f"time,T [degC],phi [deg],still [V],mode,odd [furlong]\n{ROWS}")
    told = "\n".join(cosim.check(path))
    assert "duty" not in told
    assert "39 rows missing in 1 place, first after t = 4 s, the longest 0.800" in told
    assert "still is constant at 5.00" in told
    assert 'odd "furlong" is no unit known here' in told
    assert "1 column of text not read: mode" in told
    assert "checked without a model" in told


def test_a_log_that_has_an_input_of_base_is_one_of_base(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,duty_right,x\n0,6,0\n1,6,1\n")
    with pytest.raises(InputError, match='input "duty_left" is missing'):
        cosim.check(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("time,u,x\n0,6,0\n1,6,1\n")
    with pytest.raises(InputError, match=r"input .duty_right. is missing"):
        cosim.check(tmp_path / "b.csv", "base")


def test_without_the_example_a_log_is_one_of_the_named_model_or_of_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_check, "is_model", lambda name: False)
    (tmp_path / "a.csv").write_text("time,duty_right,x\n0,6,0\n1,6,1\n2,6,3\n")
    assert "checked without a model" in "\n".join(cosim.check(tmp_path / "a.csv"))
    with pytest.raises(InputError, match=r"input .duty_left. is missing"):
        cosim.check(tmp_path / "a.csv", "base")


def test_a_table_without_a_signal_or_a_name_is_a_fault(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time\n0\n1\n")
    with pytest.raises(InputError, match=r"a.csv:1:1: holds no column beside the time"):
        cosim.check(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("time,,x\n0,1,2\n1,1,3\n")
    with pytest.raises(InputError, match=r"b.csv:1:2: the column has no name"):
        cosim.check(tmp_path / "b.csv")


def test_of_very_many_warnings_a_part_is_printed_and_json_has_all(tmp_path: Path) -> None:
    names = [f"x{k}" for k in range(260)]
    rows = "".join(f"{t}" + ",1" * 260 + "\n" for t in range(50))
    (tmp_path / "a.csv").write_text(",".join(["time", *names]) + "\n" + rows)
    printed = asked("check", tmp_path / "a.csv")
    assert 100 < printed.count("is constant at") < 260
    assert asked("check", tmp_path / "a.csv", "--json").count("is constant at") >= 260


def test_the_wrong_first_column_is_named_with_the_option_that_cures_it(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t s,x\n0,1\n1,2\n2,1\n")
    assert "--column 't s=time'" in asked("check", tmp_path / "a.csv", code=2)
    assert "'t s=time'" not in asked("check", tmp_path / "a.csv", "--column", "t s=time")


def test_all_faults_of_a_log_are_told_at_once(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(FAULTY)
    fmu = typed_fmu(tmp_path)
    expected = [
        "a.csv:1:1: cells are separated by semicolons",
        'a.csv:1:1: the first column is "t"; it must be "time" [s]',
        'a.csv:2:2: "1,5" in column drive has a decimal comma',
        'a.csv:2:3: "a" in column seen is no number',
    ]
    with pytest.raises(InputError) as by_check:
        cosim.check(tmp_path / "a.csv")
    with pytest.raises(InputError) as by_replay:
        cosim.replay(tmp_path / "a.csv", fmu=fmu, columns={"drive": "r_in", "seen": "r_out"}, in_process=True)
    with pytest.raises(InputError) as by_simulate:
        cosim.simulate(fmu, input=tmp_path / "a.csv", in_process=True)
    for text in expected:
        assert text in str(by_check.value)
        assert text.replace("column drive", "column r_in").replace("column seen", "column r_out") in str(
            by_replay.value
        )
    assert expected[0] in str(by_simulate.value)
    assert expected[1] in str(by_simulate.value)
    assert 'input "i_in" is missing' in str(by_replay.value)


@pytest.mark.parametrize("end", ["\r", "\r\n", "\n"])
def test_lines_may_end_with_any_mark(tmp_path: Path, end: str) -> None:
    (tmp_path / "a.csv").write_bytes(f"time,x{end}0,1{end}1,2{end}".encode())
    table = read_columns(tmp_path / "a.csv")
    assert (table["x"].tolist(), list(table.lines)) == ([1.0, 2.0], [2, 3])
    assert cosim.read(tmp_path / "a.csv")["x"].tolist() == [1.0, 2.0]  # type: ignore[union-attr]
    assert read_header(tmp_path / "a.csv") == ["time", "x"]


def test_numbers_that_no_double_holds_the_square_of_print_no_warning(tmp_path: Path) -> None:
    large = ["1e308", "-1e308", "1.7e308", "1e200", "-1e200", "0", "1e-320"]
    for name, step in (("a", 1), ("b", 2)):
        rows = "".join(f"{k / 50},{large[k * step % 7]},{large[(k + step) % 7]}\n" for k in range(99))
        (tmp_path / f"{name}.csv").write_text(f"time,x,y\n{rows}")
    fmu = typed_fmu(tmp_path)
    rows = "".join(f"{k / 50},{(-1) ** k * 9e29},0,1,0,{(-1) ** (k // 2) * 9e29}\n" for k in range(300))
    (tmp_path / "log.csv").write_text(f"time,r_in,i_in,e_in,b_in,r_out\n{rows}")
    rows = "".join(f"{k / 50},{(-1) ** k * 1.5e308}\n" for k in range(60))
    (tmp_path / "in.csv").write_text(f"time,r_in\n{rows}")
    criterion = {"of": "fmu.r_out", "max": 1}
    scenario = {
        "name": "s", "duration": 1, "step": 0.02,
        "components": {"fmu": {"fmu": str(fmu)}, "log": {"block": "playback", "file": str(tmp_path / "in.csv")}},
        "connections": [{"from": "log.r_in", "to": "fmu.r_in"}],
        "criteria": dict.fromkeys(("overshoot", "rms_error", "final_error", "peak", "effort"), criterion),
    }  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        compared = cosim.compare(tmp_path / "a.csv", tmp_path / "b.csv", tmp_path / "compared", tolerance=0.1)
        cosim.replay(tmp_path / "log.csv", tmp_path / "replayed", fmu, in_process=True)
        run = cosim.run(scenario, tmp_path / "ran", in_process=True)
    assert not compared.same
    assert len(run.missed) == 5


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("time|u|y\n0|1|2\n1|2|3\n", "cells are separated by vertical bars"),
        ("time  u  y\n0  1  2\n1  2  3\n", "cells are separated by blanks"),
        ("0,1,2\n1,2,3\n2,3,4\n", "the file has no header: write the names of the columns into the first line"),
        ("time,u\n0,6_3\n1,2\n", ':2:2: "6_3" in column u is no number'),
    ],
)
def test_a_table_that_only_looks_like_a_log_is_refused_with_the_cure(text: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=re.escape(reason)):
        cosim.check(tmp_path / "a.csv")
