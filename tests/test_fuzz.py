"""A small fixed number of fuzzed files and options of each kind; `make fuzz` tries thousands more."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import fuzz
from tests.fuzz import KINDS

EXAMPLES, SEED = 8, 11


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_whatever_is_read_is_answered(tmp_path: Path, plant_fmu: Path, kind: str) -> None:
    found = fuzz.fuzz(kind, EXAMPLES, SEED, tmp_path / "root", plant_fmu)
    assert found.wrong == []
    assert found.count == EXAMPLES
