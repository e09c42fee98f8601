"""Sphinx: the site of `make docs`. No page loads external content; furo contains no web font."""

import sys
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS), str(DOCS.parent)]

from reference import PAGES  # noqa: E402

from cosim.core.version import __version__  # noqa: E402

project = "cosim"
author = "The cosim authors"
copyright = author
version = release = __version__
extensions = ["myst_parser"]
exclude_patterns = ["_made", "_site", "schemas"]
smartquotes = False  # -- in the name of an option
html_theme = "furo"
html_title = f"cosim {version}"
html_extra_path = ["_made"]
html_copy_source = False
html_search_scorer = str(DOCS / "_search_scorer.js")
html_show_sphinx = False
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
suppress_warnings = [
    "myst.xref_missing",  # files of the project that are not pages; tests/test_docs.py checks all links
    "misc.highlighting_failure",  # CSV has no colours
]
linkcheck_timeout = 10


def fill(app: Any, page: str, source: list[str]) -> None:
    """Insert generated text into a reference page, and thumbnails into the gallery."""
    for marker, generate in PAGES.items():
        if marker in source[0]:
            source[0] = source[0].replace(marker, generate())
    for thumbnail in (DOCS / "_made" / "gallery").glob("*.png"):
        link = f'<a href="gallery/{thumbnail.stem}.html">'
        image = f'<img src="gallery/{thumbnail.name}" alt="" width="240"><br>'
        source[0] = source[0].replace(link, link + image)
    if (DOCS / "_made" / "gallery" / "view.png").is_file():
        picture = (
            '<img src="gallery/view.png" alt="Two runs in the signal browser: three axes, one cursor, an XY plot">'
        )
        source[0] = source[0].replace("<!-- picture: view -->", picture)


def list_changed_pages(app: Any, env: Any, added: set[str], changed: set[str], removed: set[str]) -> list[str]:
    """Return the pages that `fill` changes: Sphinx reads them again in every build."""
    return ["api", "cli", "gallery", "known", "view"]


def setup(app: Any) -> None:
    """Register the functions above."""
    app.connect("source-read", fill)
    app.connect("env-get-outdated", list_changed_pages)
