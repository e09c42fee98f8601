"""A log stands in a study once, however it is written and wherever it lies."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from cosim.core.errors import InputError
from cosim.files.yaml_file import REMOVED_KEYS
from cosim.refinement.study import read_study
from tests.logs import MOVING, fly, measured, times, write_log


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The text of a log of 8 s."""
    flight = fly(times(8.0), start=MOVING)
    return write_log(tmp_path_factory.mktemp("flown") / "a.csv", measured(flight, noise=1.0)).read_bytes()


def study(folder: Path, estimation: str = "[e.csv]", validation: str = "[v.csv]") -> Path:
    path = folder / "study.yaml"
    path.write_text(f"model: base\nlogs:\n  estimation: {estimation}\n  validation: {validation}\n")
    return path


def told(path: Path) -> list[str]:
    with pytest.raises(InputError) as refused:
        read_study(path)
    return [str(f).removeprefix(str(path)) for f in refused.value.faults]


def test_a_removed_key_is_a_fault_at_its_line_with_what_to_use_instead(tmp_path: Path) -> None:
    path = study(tmp_path)
    path.write_text(f"{path.read_text()}carry_logs: true\n")
    (fault,) = (text for text in told(path) if text.startswith(":5:1: "))
    assert REMOVED_KEYS["carry_logs"] in fault


def columns_turned_round(text: bytes) -> bytes:
    rows = [line.split(b",") for line in text.splitlines()]
    return b"\n".join(b",".join([row[0], *row[:0:-1]]) for row in rows)


@pytest.mark.parametrize(
    "rewrite",
    [
        lambda text: text,
        lambda text: text.replace(b"\n", b"\r\n"),
        lambda text: b"\xef\xbb\xbf" + text,
        lambda text: text.rstrip(b"\n"),
        lambda text: b"\n" + text,
        lambda text: text.replace(b"time", b"time [s]", 1),
        columns_turned_round,
    ],
    ids=["copy", "line ends", "byte order mark", "last line", "first line", "unit", "columns"],
)
def test_a_copy_of_a_log_is_that_log(tmp_path: Path, flown: bytes, rewrite: Callable[[bytes], bytes]) -> None:
    (tmp_path / "e.csv").write_bytes(flown)
    (tmp_path / "v.csv").write_bytes(rewrite(flown))
    same = "v.csv holds the same as e.csv, which is listed for estimation; a validation log is never fitted on"
    assert told(study(tmp_path)) == [f":4:16: {same}"]


def test_another_run_is_another_log(tmp_path: Path, flown: bytes) -> None:
    (tmp_path / "e.csv").write_bytes(flown)
    header, _, *rows = flown.splitlines(keepends=True)
    (tmp_path / "v.csv").write_bytes(b"".join([header, *rows]))
    read = read_study(study(tmp_path), "total: 10 min")
    assert len(read.logs) == 1
    assert read.content.limits is not None
    assert read.content.limits.total == 600.0
    with pytest.raises(InputError, match="--limits: totl: no such limit"):
        read_study(study(tmp_path), "totl: 10 min")


def test_one_file_under_two_names_is_told_at_each_place(tmp_path: Path, flown: bytes) -> None:
    (tmp_path / "e.csv").write_bytes(flown)
    (tmp_path / "v.csv").symlink_to("e.csv")
    assert [t[:7] for t in told(study(tmp_path, "[e.csv, ./e.csv]"))] == [":3:23: ", ":4:16: "]
