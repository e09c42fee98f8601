"""The comparator of the corpus: what it calls a difference, what an intended entry explains, and the list itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.corpus.comparison import Intended, differences, unexplained
from tests.corpus.running import Outcome

PRINTED: dict[str, Any] = {"verdict": "claimed", "value": 1.5, "message": "a sentence of several words"}
ROWS = "time,x,mode\n0,1.0,on\n1,2.0,on\n2,4.0,off\n"


def outcome(folder: Path, printed: Any = PRINTED, rows: str = ROWS, code: int = 0) -> Outcome:
    """An outcome of a command with a table."""
    (folder / "out").mkdir(parents=True)
    (folder / "out" / "results.csv").write_text(rows)
    return Outcome("run", code, printed, (), folder)


@pytest.mark.parametrize(
    ("new", "found"),
    [
        ({}, []),
        ({"code": 4}, ["exit code"]),
        ({"printed": PRINTED | {"verdict": "no_effect"}}, ["printed:verdict"]),
        ({"printed": PRINTED | {"message": "the same told in other words"}}, []),
        ({"printed": {"verdict": "claimed", "value": 1.5}}, ["printed:message"]),
        ({"rows": ROWS.replace("4.0", "4.5")}, ["out/results.csv:x"]),
        ({"rows": ROWS.replace("x", "y")}, ["out/results.csv:x", "out/results.csv:y"]),
        ({"rows": ROWS.rsplit("2,", 1)[0]}, ["out/results.csv:mode", "out/results.csv:time", "out/results.csv:x"]),
    ],
)
def test_what_differs_is_found_by_its_key(tmp_path: Path, new: dict[str, Any], found: list[str]) -> None:
    told = differences("desk: run", outcome(tmp_path / "a"), outcome(tmp_path / "b", **new))
    assert [difference.key for difference in told] == found


def test_a_missing_file_is_one_difference(tmp_path: Path) -> None:
    old, new = outcome(tmp_path / "a"), outcome(tmp_path / "b")
    (new.files or tmp_path).joinpath("out", "results.csv").rename(tmp_path / "b" / "out" / "rows.csv")
    assert [d.key for d in differences("desk: run", old, new)] == ["out/results.csv", "out/rows.csv"]
    entry = Intended("desk: *", "rows have another name", instead={"results.csv": "rows.csv"})
    assert differences("desk: run", old, new, 0.0, [entry]) == []
    assert entry.uses == 1


def test_an_entry_explains_the_keys_of_its_commands_and_counts_its_uses(tmp_path: Path) -> None:
    new = PRINTED | {"value": 2.0, "verdict": "no_effect"}
    found = differences("desk: run", outcome(tmp_path / "a"), outcome(tmp_path / "b", new))
    used, other = Intended("desk: r*", "as the issue says", ["printed:val*"]), Intended("else: *", "-", ["*"])
    assert [difference.key for difference in unexplained(found, [used, other])] == ["printed:verdict"]
    assert (used.uses, other.uses) == (1, 0)
