"""Pages out of templates. What all pages share stands here (style, script, plots); others keep their page beside."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

TEMPLATES = Path(__file__).with_name("templates")


def render(page: Path, values: Mapping[str, Any], folders: Sequence[Path] = ()) -> str:
    """One self-contained page; its template finds those shared by all, and those in further folders.

    A style or script that stands beside the page, as `NAME.css` and `NAME.js`, comes with those of all pages.
    """
    # jinja2 is needed by nothing else, so `import cosim.report` does without it.
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader([page.parent, *folders, TEMPLATES]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["code"] = _code
    stem = page.name.partition(".")[0]
    # a page's own script listens to that of all pages, so it comes first; a style goes over that of all pages
    style = "".join(_text(f) for f in (TEMPLATES / "report.css", page.with_name(f"{stem}.css")))
    script = "".join(_text(f) for f in (page.with_name(f"{stem}.js"), TEMPLATES / "charts.js", TEMPLATES / "report.js"))
    return environment.get_template(page.name).render(**values, style=style, script=script)


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8") if path.is_file() else ""


def _code(text: str) -> str:
    """What stands between backticks as code."""
    from markupsafe import Markup, escape

    return Markup(re.sub("`([^`]+)`", r"<code>\1</code>", str(escape(text))))
