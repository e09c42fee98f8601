"""Pages out of templates. What all pages share stands here (style, script, plots); others keep their page beside."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

TEMPLATES = Path(__file__).with_name("templates")


def render(page: Path, values: Mapping[str, Any]) -> str:
    """One self-contained page; its template finds those shared by all."""
    # jinja2 is needed by nothing else, so `import cosim.report` does without it.
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader([page.parent, TEMPLATES]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["code"] = _code
    style, script = (TEMPLATES.joinpath(f"report.{kind}").read_text(encoding="utf-8") for kind in ("css", "js"))
    return environment.get_template(page.name).render(**values, style=style, script=script)


def _code(text: str) -> str:
    """What stands between backticks as code."""
    from markupsafe import Markup, escape

    return Markup(re.sub("`([^`]+)`", r"<code>\1</code>", str(escape(text))))
