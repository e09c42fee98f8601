"""Templates, styles and scripts of pages: readable at their source, small in the page."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from cosim.report.template import render

ROOT = Path(__file__).resolve().parent.parent
SOURCES = sorted(
    path.relative_to(ROOT).as_posix()
    for package in ("cosim", "plant", "controller", "fmus")
    for kind in ("*.j2", "*.css", "*.js")
    for path in (ROOT / package).rglob(kind)
)


@pytest.mark.parametrize("source", SOURCES)
def test_a_line_fits_the_page_of_an_editor(source: str) -> None:
    lines = (ROOT / source).read_text(encoding="utf-8").splitlines()
    assert [number for number, line in enumerate(lines, 1) if len(line) > 120] == []


@pytest.mark.parametrize("source", [s for s in SOURCES if s.endswith(".j2")])
def test_a_template_holds_neither_style_nor_script(source: str) -> None:
    text = (ROOT / source).read_text(encoding="utf-8")
    inner = re.findall(r"<(style|script)[^>]*>(.*?)</\1>", text, re.DOTALL)
    assert [code for _, code in inner if not re.fullmatch(r"\s*\{\{ \w+ \| safe \}\}\s*", code)] == []


def test_a_page_takes_the_styles_and_scripts_beside_it_without_comments_and_indentation(tmp_path: Path) -> None:
    (tmp_path / "page.html.j2").write_text("<style>{{ style | safe }}</style><script>{{ script | safe }}</script>")
    (tmp_path / "other.css").write_text("/* why */\n.mine {\n  color: red;\n}\n")
    (tmp_path / "own.js").write_text('// why\nif (mine) {\n  // how\n  call("a // b");\n}\n')
    page = render(tmp_path / "page.html.j2", {})
    assert ".mine {\ncolor: red;\n}\n</style>" in page
    assert '<script>if (mine) {\ncall("a // b");\n}\n' in page
