"""The table of known answers."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.known.__main__ import format_cases
from tests.known.cases import CASES
from tests.known.table import Case, check

EVERY = [case for cases in CASES.values() for case in cases]


@pytest.mark.parametrize(
    ("case", "variant"),
    [
        pytest.param(
            case, variant, id=f"{case.name}-{variant}".rstrip("-"),
            marks=[pytest.mark.xfail(strict=True, reason=case.later)] if case.later else [],
        )
        for case in EVERY
        for variant in case.variants
    ],
)  # fmt: skip
def test_the_answer_is_known(case: Case, variant: str, tmp_path: Path) -> None:
    outcome = case.variants[variant](tmp_path)
    for answer in case.answers:
        check(outcome, answer)


def test_the_page_has_the_rows_of_the_table() -> None:
    page = format_cases()
    names = [line.split("`")[1] for line in page.splitlines() if line.startswith("| `")]
    assert sorted(names) == sorted(case.name for case in EVERY)
