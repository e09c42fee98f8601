"""Pages from templates: shared files are in `templates`, a page's own style and script beside its template."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.core import text as text_of_numbers
from cosim.core.messages import printable
from cosim.files.cache import cache_folder

IN_TEMPLATES = ("MISSING", "amount", "counted", "percent", "plain", "size")  # of `cosim.core.text`
TEMPLATES = Path(__file__).with_name("templates")


def render(page: Path, values: Mapping[str, Any], folders: Sequence[Path] = (), *, is_report: bool = True) -> str:
    """Return a self-contained HTML page from a template.

    The template may use the shared templates, templates in `folders`, and the functions IN_TEMPLATES. Every `.css` and
    `.js` in the page's folder is inlined. Lines of a template literal lose their indentation.

    Args:
        is_report: Whether the page draws the charts of `Charts.data` by itself.
    """
    # Only pages need jinja2: `import cosim.report` must not load it.
    from jinja2 import Environment, FileSystemBytecodeCache, FileSystemLoader, StrictUndefined
    from markupsafe import Markup, escape

    compiled = cache_folder() / "templates"
    compiled.mkdir(mode=0o700, exist_ok=True)
    environment = Environment(
        loader=FileSystemLoader([page.parent, *folders, TEMPLATES]),
        bytecode_cache=FileSystemBytecodeCache(str(compiled)),
        autoescape=True,
        finalize=lambda value: type(value)(printable(value)) if isinstance(value, str) else value,  # HTML stays HTML
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= {name: getattr(text_of_numbers, name) for name in IN_TEMPLATES}
    environment.filters["code"] = lambda text: Markup(re.sub("`([^`]+)`", r"<code>\1</code>", str(escape(text))))
    # A page's own style overrides the shared style.
    style = inline([TEMPLATES / "report.css", *sorted(page.parent.glob("*.css"))])
    scripts = [TEMPLATES / "chart.js", *sorted(page.parent.glob("*.js"))]
    script = inline([*scripts, *([TEMPLATES / "report.js"] if is_report else [])])
    return environment.get_template(page.name).render(**values, style=style, script=script)


def inline(files: Sequence[Path]) -> str:
    """Return files' texts without indentation and comment lines."""
    text = "\n".join(file.read_text(encoding="utf-8") for file in files)
    return re.sub(r"^\s*(?://.*|/\*.*\*/)?\n|^[ \t]+", "", text, flags=re.MULTILINE)
