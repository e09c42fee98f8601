"""Pages from templates: shared files are in `templates`, the style and script of one page beside its template."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from cosim.core import text as text_of_numbers
from cosim.core.messages import printable
from cosim.core.version import __version__
from cosim.files.cache import cache_folder
from cosim.report.charts import Charts

IN_TEMPLATES = ("MISSING", "amount", "counted", "percent", "plain", "size")  # of `cosim.core.text`
TEMPLATES = Path(__file__).with_name("templates")
SECTION = re.compile(r'<section id="([^"]+)"(?: data-nav="([^"]+)")?>\s*<h2>(.*?)</h2>')
NO_OPTIONS: Mapping[str, Iterable[str]] = MappingProxyType({})


@dataclass(frozen=True)
class Row:
    """A row of a table: a label, a value, and a note."""

    label: str
    value: str
    note: str = ""


def command(*words: str, options: Mapping[str, Iterable[str]] = NO_OPTIONS) -> str:
    """Return a command line in which each option is repeated for each of its values."""
    return shlex.join([*words, *(word for flag, values in options.items() for v in values for word in (flag, v))])


def assignments(values: Mapping[str, Any]) -> list[str]:
    """Return values as `name=value` of a command line."""
    return [f"{name}={str(v).lower() if isinstance(v, bool) else v}" for name, v in values.items()]


def places(**values: float) -> dict[str, float]:
    """Return the positions [%] of finite values on a ruler (macro `ruler`), from the least to the largest."""
    finite = {name: value for name, value in values.items() if math.isfinite(value)}
    low = min(finite.values(), default=0.0)
    span = max(finite.values(), default=0.0) - low
    return {name: round(4.0 + 92.0 * (v - low) / span, 2) if span else 50.0 for name, v in finite.items()}


def render(
    page: Path,
    values: Mapping[str, Any],
    charts: Charts | None = None,
    folders: Sequence[Path] = (),
    *,
    is_report: bool = True,
) -> str:
    """Return a self-contained HTML page from a template.

    The template may use the shared templates, templates in `folders`, and the functions IN_TEMPLATES. Every `.css` and
    `.js` in the page's folder is inlined. Indentation is removed from all inlined lines, also in template literals.

    Args:
        charts: All charts of the page, unless `values` contains the chart data under the key `data`.
        is_report: True for a page that draws all its charts when it opens.
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
    environment.filters["sections"] = lambda body: [[Markup(text) for text in found] for found in SECTION.findall(body)]
    # A page's own style overrides the shared style.
    style = inline([TEMPLATES / "report.css", *sorted(page.parent.glob("*.css"))])
    scripts = [TEMPLATES / "chart.js", *sorted(page.parent.glob("*.js"))]
    script = inline([*scripts, *([TEMPLATES / "report.js"] if is_report else [])])
    shared = {"version": __version__, "data": charts.data() if charts else "{}", "style": style, "script": script}
    return environment.get_template(page.name).render({**shared, **values})


def inline(files: Sequence[Path]) -> str:
    """Return the texts of files without indentation and comment lines."""
    text = "\n".join(file.read_text(encoding="utf-8") for file in files)
    return re.sub(r"^\s*(?://.*|/\*.*\*/)?\n|^[ \t]+", "", text, flags=re.MULTILINE)
