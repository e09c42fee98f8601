"""Documentation inside an FMU: an HTML page with description, equations and variables, and the licence."""

from __future__ import annotations

import inspect
from html import escape
from pathlib import Path

from cosim.fmi.model_description import LICENCE, Description
from cosim.fmi.sampled import AUTHOR
from cosim.model.model import AUTO, RK4, STIFF, Model

ASSETS = Path(__file__).resolve().parent / "assets"
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #1c2430; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.15rem; margin-top: 2rem; }
pre { background: #f4f6f8; padding: 1rem; overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .9rem; }
th, td { text-align: left; padding: .3rem .6rem; border-bottom: 1px solid #d8dee6; vertical-align: top; }
td.number { font-variant-numeric: tabular-nums; white-space: nowrap; }
"""

NEEDS = "<p>Integration: {method} in equal substeps of at most {substep:g} ms, inputs held.</p>"
METHOD = {AUTO: "RK4", RK4: "RK4", STIFF: "RODAS, linearly implicit,"}
SWITCHES = """<p>Parameters with a dot, <code>effect.parameter</code>, switch on effects the base model lacks. At their
start value an effect is dormant and costs nothing.</p>"""


def docstrings_html(*owners: object) -> str:
    """Return the docstrings of modules or classes as HTML."""
    return "".join(f"<pre>{escape(inspect.getdoc(owner) or '')}</pre>" for owner in owners)


def model_text(model: Model) -> str:
    """Return a model's documentation as HTML: equations, effects, integration."""
    effects = "".join(f"<li><code>{k.name}</code>: {escape(k.equation)}</li>" for k in model.catalogue)
    catalogue = f"{SWITCHES}<ul>{effects}</ul>" if effects else ""
    needs = NEEDS.format(method=METHOD[model.integrator], substep=1000 * model.substep)
    return docstrings_html(type(model), model.equations) + needs + catalogue


def documentation(about: Description, text: str, version: str, guid: str, way: str) -> dict[str, bytes]:
    """Return the files of the FMU's folder `documentation`: its page `index.html`, and the licence."""
    title, tables = escape(about.description), ""
    for head, causality in (("Inputs", "input"), ("Outputs", "output"), ("Parameters", "parameter")):
        rows = "".join(
            f"<tr><td><code>{escape(p.name)}</code></td><td class=number>{'' if p.causality == 'output' else p.start}"
            f"</td><td>{escape(p.unit)}</td><td>{escape(p.doc)}</td></tr>"
            for p in about.ports
            if p.causality == causality
        )
        tables += f"<h2>{head}</h2><table><tr><th>Variable<th>Start<th>Unit<th>Meaning</tr>{rows}</table>"
    page = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>'
        f"<h1>{title}</h1><p>Version {escape(version)} · {way} · communication step {about.step} s<br>"
        f'{AUTHOR} · licence {LICENCE} (<a href="license.txt">text</a>) · GUID <code>{guid}</code></p>'
        f"{text}{tables}</html>\n"
    )
    return {"index.html": page.encode(), "license.txt": (ASSETS / "license.txt").read_bytes()}
