"""Measures of the prose: `python -m tests.english` prints them for docstrings and for documents.

A fragment is a first line that starts with neither a verb nor a noun phrase, for example "What ..." or "Whether ...".
The share of pronouns counts words such as "it", "that" and "which" among all words of the docstrings of functions.
"""

from __future__ import annotations

import ast
import re
import statistics
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("cosim", "plant", "controller", "fmus", "benchmarks")
FRAGMENTS = {
    *("what", "whether", "of", "as", "by", "where", "which", "with", "it", "its", "not", "no"),
    *("if", "from", "how", "who", "whose", "in", "on", "to", "over"),
}
PRONOUNS = {"what", "that", "which", "one", "those", "it", "they", "whose", "there", "where", "such", "other"}
MAX_README_WORDS = 700
MAX_PARAGRAPH_WORDS = 80
HAND_WRITTEN = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
NO_PROSE = re.compile(r"^```.*?^```|^:::.*?^:::|<!--.*?-->|^---\n.*?^---\n", re.MULTILINE | re.DOTALL)
NEW_PARAGRAPH = re.compile(r"\n\s*\n|\n(?=\s*(?:[-*+]|\d+\.)\s)|\n(?=\s*\|)|(?<=\|)\n")


def read_docstrings(package: str) -> Iterator[str]:
    """Yield the docstring of every function of a package."""
    for path in sorted((ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and (text := ast.get_docstring(node)):
                yield text


def split_words(text: str) -> list[str]:
    """Return the words of a text in lower case, without punctuation."""
    return re.findall(r"[^\W\d_][\w'’-]*", text.lower())


def split_paragraphs(page: Path) -> list[str]:
    """Return the paragraphs and list items of a page; code, tables and headings are no paragraphs."""
    parts = NEW_PARAGRAPH.split("\n" + NO_PROSE.sub("\n\n", page.read_text(encoding="utf-8")))
    return [part.strip() for part in parts if part.strip() and not re.match(r"\s*(\||#|    \S)", part.strip("\n"))]


def find_long_paragraphs(page: Path) -> list[str]:
    """Return the paragraphs of a page with too many words, each with its number of words."""
    counted = [(len(text.split()), text) for text in split_paragraphs(page)]
    return [
        f"{page.relative_to(ROOT)}: {count} words: {' '.join(text.split()[:8])} ..."
        for count, text in counted
        if count > MAX_PARAGRAPH_WORDS
    ]


def measure(texts: Sequence[str]) -> tuple[float, float, float]:
    """Return the shares of fragments and pronouns in docstrings, and the first lines' median words."""
    first_lines = [split_words(text.splitlines()[0]) for text in texts]
    all_words = [word for text in texts for word in split_words(text)]
    fragments = sum(bool(line) and line[0] in FRAGMENTS for line in first_lines) / len(texts)
    pronouns = sum(word in PRONOUNS for word in all_words) / len(all_words)
    return fragments, pronouns, statistics.median(map(len, first_lines))


def format_docstring_line(package: str) -> str:
    """Return the measures of a package's docstrings as a line of a table."""
    texts = list(read_docstrings(package))
    fragments, pronouns, median = measure(texts)
    return f"{package:12}{len(texts):6}{fragments:12.1%}{pronouns:11.1%}{median:9.0f}"


def main() -> None:
    """Print the measures."""
    print(f"{'package':12}{'count':>6}{'fragments':>12}{'pronouns':>11}{'median':>9}  (words of the first line)")
    for package in PACKAGES:
        print(format_docstring_line(package))
    print(f"\n{'document':32}{'words':>7}{'longest paragraph':>19}")
    for page in HAND_WRITTEN:
        lengths = [len(text.split()) for text in split_paragraphs(page)]
        total = len(page.read_text(encoding="utf-8").split())
        print(f"{page.relative_to(ROOT)!s:32}{total:7}{max(lengths):19}")
    for page in HAND_WRITTEN:
        print("\n".join(find_long_paragraphs(page)), end="\n" if find_long_paragraphs(page) else "")


if __name__ == "__main__":
    main()
