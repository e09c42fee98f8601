"""A log without a model, all its faults at once, line ends of any kind, and numbers beyond what a double can square."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

import cosim
from cosim.core.errors import InputError

ROWS = "".join(
    f"{k * 0.02:.2f},{20 + math.sin(k / 9)},{90 * math.sin(k / 7)},5,RUN,{k * k % 17}\n"
    for k in range(600)
    if not 200 < k < 240
)


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


def test_a_table_without_a_signal_or_a_name_is_a_fault(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time\n0\n1\n")
    with pytest.raises(InputError, match=r"a.csv:1:1: holds no column beside the time"):
        cosim.check(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("time,,x\n0,1,2\n1,1,3\n")
    with pytest.raises(InputError, match=r"b.csv:1:2: the column has no name"):
        cosim.check(tmp_path / "b.csv")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("time  u  y\n0  1  2\n1  2  3\n", "cells are separated by blanks"),
        ("0,1,2\n1,2,3\n2,3,4\n", "the file has no header: write the names of the columns into the first line"),
        ("time,u\n0,6_3\n1,2\n", ':2:2: "6_3" in column u is no number'),
    ],
)
def test_a_table_that_only_looks_like_a_log_is_refused_with_the_cure(text: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=re.escape(reason)):
        cosim.check(tmp_path / "a.csv")
