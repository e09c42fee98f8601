"""A small fixed number of fuzzed files and options of each kind; `make fuzz` tries thousands more."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests import fuzz
from tests.fuzz import KINDS

EXAMPLES, SEED = 8, 11


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_whatever_is_read_is_answered(tmp_path: Path, plant_fmu: Path, kind: str) -> None:
    found = fuzz.fuzz(kind, EXAMPLES, SEED, tmp_path / "root", plant_fmu)
    assert found.wrong == []
    assert found.count[kind] == EXAMPLES


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("raise ValueError('no error of ours')", "exit None"),
        ("sys.exit(1)", "exit 1"),
        ("print('NoneType has none'); sys.exit(2)", "says 'NoneType'"),
        ("open('../../left', 'w').close(); sys.exit(0)", "left "),
    ],
)
def test_the_fuzz_sees_what_is_wrong(
    tmp_path: Path, plant_fmu: Path, monkeypatch: pytest.MonkeyPatch, entry: str, words: str
) -> None:
    def wrong() -> None:
        exec(entry, {"sys": fuzz.sys})

    def one(draw: Any, folder: Path) -> Iterator[list[str]]:
        yield ["check"]

    monkeypatch.setattr(fuzz, "entry", wrong)
    monkeypatch.setitem(KINDS, "one", one)
    (told,) = fuzz.fuzz("one", 1, SEED, tmp_path / "root", plant_fmu).wrong
    assert words in told
