"""Model descriptions, completed from those of pythonfmu, and the documentation inside an FMU."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, Literal
from xml.etree.ElementTree import Element, SubElement, fromstring, indent, tostring

from cosim.core.units import DISPLAY, unit_definitions
from cosim.fmi.ports import Port
from cosim.fmi.sampled import AUTHOR, FRAME, TOOL
from cosim.model.model import AUTO, RK4, STIFF, Model
from cosim.model.traits import Traits

LICENCE = "MIT"
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
KINDS3 = {"Real": "Float64", "Boolean": "Boolean", "String": "String"}


@dataclass(frozen=True)
class Description:
    """Content of a model description apart from names and start values of variables.

    Attributes:
        sampled: Parameter with the only accepted communication step [s]; "" accepts any step.
    """

    description: str
    ports: Sequence[Port]
    dependencies: Mapping[str, Sequence[str]]
    initial_dependencies: Mapping[str, Sequence[str]]
    step: float
    stop: float
    variable_step: bool
    traits: Traits | None = None
    sampled: str = ""


# FMI's structured names without quotes: names joined by dots, perhaps with indices, or the derivative of such a name
_PART = r"[A-Za-z_][A-Za-z0-9_]*(\[\d+(,\d+)*\])?"
STRUCTURED = re.compile(rf"{_PART}(\.{_PART})*|der\({_PART}(\.{_PART})*\)", re.ASCII)


def naming_convention(names: Iterable[str]) -> str:
    """Return FMI's naming convention, `structured` if possible, else `flat`."""
    return "structured" if all(STRUCTURED.fullmatch(name) for name in names) else "flat"


def complete(xml: bytes, about: Description, version: str, guid: str) -> bytes:
    """Return pythonfmu's model description with all missing content."""
    root: Any = fromstring(xml)
    root.attrib.pop("generationDateAndTime", None)  # Equal sources must give equal bytes.
    root.attrib |= {
        "guid": guid,
        "description": about.description,
        "author": AUTHOR,
        "version": version,
        "license": LICENCE,
        "copyright": AUTHOR,
        "variableNamingConvention": naming_convention(port.name for port in about.ports),
    }
    capabilities, variables = root.find("CoSimulation"), root.find("ModelVariables")
    capabilities.attrib |= {
        "canHandleVariableCommunicationStepSize": str(about.variable_step).lower(),
        "canGetAndSetFMUstate": "true",
        "canSerializeFMUstate": "true",
    }
    root.insert(list(root).index(capabilities) + 1, unit_definitions({p.unit for p in about.ports if p.unit}))
    for element in (default_experiment(about), *vendor_annotations(about, "json")):
        root.insert(list(root).index(variables), element)
    for element in (variables, root.find("ModelStructure")):
        root.remove(element)
    root.append(model_variables(about))
    root.append(model_structure(about))
    return xml_bytes(root)


def xml_bytes(root: Element) -> bytes:
    """Return an indented XML file."""
    indent(root)
    text: bytes = tostring(root, encoding="UTF-8", xml_declaration=True)
    return text + b"\n"


def default_experiment(about: Description) -> Element:
    """Return the default experiment."""
    times = {"startTime": "0", "stopTime": repr(about.stop), "stepSize": repr(about.step), "tolerance": "1e-6"}
    return Element("DefaultExperiment", times)


def set_unit_and_limits(node: Element, unit: str, bounds: tuple[float, float] = (-math.inf, math.inf)) -> None:
    """Set unit, display unit and finite limits of a variable."""
    if unit:
        node.set("unit", unit)
        if display := DISPLAY.get(unit):
            node.set("displayUnit", display[0])
    for name, limit in zip(("min", "max"), bounds, strict=True):
        if math.isfinite(limit):
            node.set(name, repr(float(limit)))


def vendor_annotations(about: Description, state: str) -> list[Element]:
    """Return `VendorAnnotations`, each with a single element as FMI demands: of traits, and of the accepted step.

    Args:
        state: Format of the serialized FMU state.
    """
    annotations = []

    def add(tag: str, **attributes: str) -> Element:
        annotations.append(Element("VendorAnnotations"))
        return SubElement(SubElement(annotations[-1], "Tool", name=TOOL), tag, attributes)

    if traits := about.traits:
        node = add("Traits", state=state)
        for name, rate in traits.rates.items():
            SubElement(node, "Rate", of=name, signal=rate)
        for name, (low, high) in traits.bounds.items():
            SubElement(node, "Limits", of=name, low=repr(low), high=repr(high))
        if traits.planar:
            SubElement(node, "PlanarFrame", {key: getattr(traits.planar, key) for key in FRAME})
    if about.sampled:
        node = add("Sampled", parameter=about.sampled)
        if optional := " ".join(port.name for port in about.ports if port.optional):
            node.set("optional", optional)
    return annotations


@dataclass(frozen=True)
class Local:
    """A variable of native FMUs only."""

    name: str
    role: Literal["state", "derivative", "memory", "indicator"]
    unit: str
    doc: str


def model_variables(about: Description, fmi: int = 2, locals: Sequence[Local] = ()) -> Element:
    """Return ModelVariables: the ports and the local variables, without event indicators in FMI 2.0."""
    ports = about.ports
    variables = Element("ModelVariables")
    if fmi == 3:  # FMI 3.0 requires the time.
        reference = str(len(ports) + len(locals))
        head = {"name": "time", "valueReference": reference, "causality": "independent", "variability": "continuous"}
        SubElement(variables, "Float64", head)

    def add(kind: str, reference: int, name: str, doc: str, more: dict[str, str]) -> Element:
        """Add a variable and return the element with the attributes of its type."""
        head = {"name": name, "valueReference": str(reference), **({"description": doc} if doc else {}), **more}
        if fmi == 3:
            return SubElement(variables, KINDS3[kind], head)
        return SubElement(SubElement(variables, "ScalarVariable", head), kind)

    for k, port in enumerate(ports):
        more = {"causality": port.causality, "variability": "continuous" if port.kind == "Real" else "discrete"}
        if port.causality == "parameter":
            more |= {"variability": "fixed", "initial": "exact"}
        elif port.causality == "output":
            more["initial"] = "calculated"
        node = add(port.kind, k, port.name, port.doc, more)
        if port.kind == "Real":
            set_unit_and_limits(node, port.unit, port.bounds)
        if port.causality == "output":
            continue
        if isinstance(port.start, str):
            start = port.start
        else:
            start = str(port.start).lower() if isinstance(port.start, bool) else repr(float(port.start))
        if port.kind == "String" and fmi == 3:
            SubElement(node, "Start", value=start)
        else:
            node.set("start", start)
    rates = [v.name for v in locals if v.role == "derivative"]
    for k, v in enumerate(locals, len(ports)):
        if v.role == "indicator" and fmi == 2:
            continue
        variability = "discrete" if v.role == "memory" else "continuous"
        node = add(
            "Real", k, v.name, v.doc, {"causality": "local", "variability": variability, "initial": "calculated"}
        )
        set_unit_and_limits(node, v.unit)
        if v.role == "derivative":
            # States come first. FMI 2.0 counts variables from 1.
            node.set("derivative", str(len(ports) + rates.index(v.name) + (fmi == 2)))
    return variables


def model_structure(
    about: Description,
    fmi: int = 2,
    locals: Sequence[Local] = (),
    dependencies: Mapping[str, Sequence[str]] | None = None,
) -> Element:
    """Return ModelStructure with dependencies, by default those of the description."""
    variables: list[Port | Local] = [*about.ports, *locals]
    numbers = {v.name: k + (fmi == 2) for k, v in enumerate(variables)}
    states, rates, indicators = ([v.name for v in locals if v.role == r] for r in ("state", "derivative", "indicator"))
    outputs = [p.name for p in about.ports if p.causality == "output"]
    dependencies, starting = dependencies or about.dependencies, about.initial_dependencies
    initial = {**{n: starting[n] for n in outputs}, **dict.fromkeys((*states, *rates))}
    structure = Element("ModelStructure")

    def add(parent: Element, tag: str, unknowns: Mapping[str, Sequence[str] | None]) -> None:
        for name, sources in unknowns.items():
            node = SubElement(parent, tag, {"index" if fmi == 2 else "valueReference": str(numbers[name])})
            if sources is not None:
                node.set("dependencies", " ".join(map(str, sorted(numbers[n] for n in sources))))

    if fmi == 2:
        add(SubElement(structure, "Outputs"), "Unknown", {n: dependencies[n] for n in outputs})
        if rates:
            add(SubElement(structure, "Derivatives"), "Unknown", {n: dependencies[n] for n in rates})
        add(SubElement(structure, "InitialUnknowns"), "Unknown", initial)
    else:
        add(structure, "Output", {n: dependencies[n] for n in outputs})
        add(structure, "ContinuousStateDerivative", {n: dependencies[n] for n in rates})
        add(structure, "InitialUnknown", initial)
        add(structure, "EventIndicator", dict.fromkeys(indicators))
    return structure


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
