"""Limits of the documents' prose (tests/english.py prints all measures)."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.english import (
    HAND_WRITTEN,
    MAX_README_WORDS,
    ROOT,
    find_long_paragraphs,
    split_paragraphs,
)


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= MAX_README_WORDS


@pytest.mark.parametrize("page", HAND_WRITTEN, ids=lambda page: page.stem)
def test_paragraphs_of_a_document_are_short(page: Path) -> None:
    assert find_long_paragraphs(page) == []


def test_paragraphs_are_counted_without_code_tables_and_headings(tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text(
        "# Title\n\none two\nthree\n| a | b |\n|---|---|\n\n- four\n- five\n\n```\nsix\n```\n"
    )
    assert split_paragraphs(tmp_path / "page.md") == ["one two\nthree", "- four", "- five"]
