"""The comparator of the corpus: what it calls a difference, what an intended entry explains, and the list itself."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.corpus.__main__ import chosen, migrated, read_desks
from tests.corpus.comparison import Intended, differences, flatten, leaf_difference, read_intended, unexplained
from tests.corpus.running import Desk, Outcome

HERE = Path(__file__).parent / "corpus"
PRINTED: dict[str, Any] = {"verdict": "claimed", "value": 1.5, "message": "a sentence of several words"}
ROWS = "time,x,mode\n0,1.0,on\n1,2.0,on\n2,4.0,off\n"


def outcome(folder: Path, printed: Any = PRINTED, rows: str = ROWS, code: int = 0) -> Outcome:
    """An outcome of a command with a table."""
    (folder / "out").mkdir(parents=True)
    (folder / "out" / "results.csv").write_text(rows)
    return Outcome("run", code, 1.0, printed, (), folder)


def keys(folder: Path, tolerance: float = 0.0, **new: Any) -> list[str]:
    """The keys that differ between an outcome and one with changes."""
    pair = outcome(folder / "a"), outcome(folder / "b", **new)
    return [difference.key for difference in differences("desk: run", *pair, tolerance)]


@pytest.mark.parametrize(
    ("new", "found"),
    [
        ({}, []),
        ({"code": 4}, ["exit code"]),
        ({"printed": PRINTED | {"verdict": "no_effect"}}, ["printed:verdict"]),
        ({"printed": PRINTED | {"value": 1.5000001}}, ["printed:value"]),
        ({"printed": PRINTED | {"message": "the same told in other words"}}, []),
        ({"printed": PRINTED | {"message": None}}, ["printed:message"]),
        ({"printed": {"verdict": "claimed", "value": 1.5}}, ["printed:message"]),
        ({"printed": PRINTED | {"further": 1}}, ["printed:further"]),
        ({"printed": None}, ["printed"]),
        ({"rows": ROWS.replace("4.0", "4.5")}, ["out/results.csv:x"]),
        ({"rows": ROWS.replace("4.0", "")}, ["out/results.csv:x"]),
        ({"rows": ROWS.replace("off", "on")}, ["out/results.csv:mode"]),
        ({"rows": ROWS.replace("x", "y")}, ["out/results.csv:x", "out/results.csv:y"]),
        ({"rows": ROWS.rsplit("2,", 1)[0]}, ["out/results.csv:mode", "out/results.csv:time", "out/results.csv:x"]),
    ],
)
def test_what_differs_is_found_by_its_key(tmp_path: Path, new: dict[str, Any], found: list[str]) -> None:
    assert keys(tmp_path, **new) == found


def test_a_tolerance_is_relative_to_a_number_and_to_the_largest_of_a_column(tmp_path: Path) -> None:
    new = {"printed": PRINTED | {"value": 1.50001}, "rows": ROWS.replace("1.0", "1.00003")}
    assert keys(tmp_path / "within", 1e-5, **new) == []
    assert keys(tmp_path / "beyond", 1e-6, **new) == ["out/results.csv:x", "printed:value"]
    assert leaf_difference(0.0, 1e-13, 1e-6) is None
    assert leaf_difference(float("nan"), float("nan"), 0.0) is None
    assert leaf_difference(True, 1, 0.0) is not None
    assert leaf_difference("2026-11-28T19:40:37+00:00", "2026-11-28T20:00:52+00:00", 0.0) is None
    assert leaf_difference(np.array([np.nan, 1.0]), np.array([1.0, 1.0]), 0.1) is not None


def test_integers_beyond_doubles_are_compared_by_their_digits(tmp_path: Path) -> None:
    first, second = ("n\n9007199254740993\n", "n\n9007199254740992\n")
    old, new = outcome(tmp_path / "a", {"n": 2**53 + 1}, first), outcome(tmp_path / "b", {"n": 2**53}, second)
    assert [d.key for d in differences("desk: run", old, new)] == ["out/results.csv:n", "printed:n"]


def test_a_missing_file_is_one_difference(tmp_path: Path) -> None:
    old, new = outcome(tmp_path / "a"), outcome(tmp_path / "b")
    (new.files or tmp_path).joinpath("out", "results.csv").rename(tmp_path / "b" / "out" / "rows.csv")
    assert [d.key for d in differences("desk: run", old, new)] == ["out/results.csv", "out/rows.csv"]
    entry = Intended("desk: *", "rows have another name", instead={"results.csv": "rows.csv"})
    assert differences("desk: run", old, new, 0.0, [entry]) == []
    assert entry.uses == 1


def test_the_description_of_an_fmu_counts_and_its_guid_does_not(tmp_path: Path) -> None:
    def fmu(folder: Path, guid: str, start: float) -> Outcome:
        made = outcome(folder)
        with zipfile.ZipFile(folder / "plant.fmu", "w") as archive:
            text = f'<fmiModelDescription guid="{guid}"><Variable name="m" start="{start}"/></fmiModelDescription>'
            archive.writestr("modelDescription.xml", text)
        return made

    first, same, other = (fmu(tmp_path / g, g, v) for g, v in (("a", 1.0), ("b", 1.0), ("c", 2.0)))
    assert differences("desk: build", first, same) == []
    (found,) = differences("desk: build", first, other)
    assert (found.key, found.old, found.new) == ("plant.fmu:modelDescription.xml..Variable.m@start", "1.0", "2.0")


def test_values_of_volatile_keys_are_not_compared_but_their_keys_are() -> None:
    assert flatten({"timings": {"total": 1.0}}) == flatten({"timings": {"total": 2.0}})
    assert flatten({"timings": {"total": 1.0}}) != flatten({})


def test_an_entry_explains_the_keys_of_its_commands_and_counts_its_uses(tmp_path: Path) -> None:
    new = PRINTED | {"value": 2.0, "verdict": "no_effect"}
    found = differences("desk: run", outcome(tmp_path / "a"), outcome(tmp_path / "b", new))
    used, other = Intended("desk: r*", "as the issue says", ["printed:val*"]), Intended("else: *", "-", ["*"])
    assert [difference.key for difference in unexplained(found, [used, other])] == ["printed:verdict"]
    assert (used.uses, other.uses) == (1, 0)


def test_an_entry_gives_a_command_of_the_new_side_other_words() -> None:
    desk = Desk("scenarios", ("cosim run a.yaml", "cosim run b.yaml"))
    entry = Intended("scenarios: * a.yaml", "a scenario has moved", instead={"a.yaml": "c.yaml"})
    assert migrated({"scenarios": desk}, [entry]) == {
        "scenarios": replace(desk, commands=("cosim run c.yaml", "cosim run b.yaml"))
    }
    assert entry.uses == 1


def test_intended_differences_are_at_most_thirty_and_have_a_reason(tmp_path: Path) -> None:
    path, entry = tmp_path / "intended.yaml", {"commands": "*", "because": "as the issue says", "keys": ["*"]}
    path.write_text(json.dumps([entry] * 30))
    assert len(read_intended(path)) == 30
    for wrong in ([entry] * 31, [entry | {"because": " "}]):
        path.write_text(json.dumps(wrong))
        with pytest.raises(SystemExit):
            read_intended(path)


def test_the_list_of_commands_and_the_intended_differences_can_be_read() -> None:
    desks, not_run = read_desks(HERE / "commands.yaml")
    assert sum(len(desk.commands) for desk in desks.values()) >= 150
    assert all(not_run.values())
    assert [*chosen(desks, "my_log")] == ["my_fmus", "my_log"]
    read_intended(HERE / "intended.yaml")
