"""Model descriptions, completed from those of pythonfmu, and documentation pages of FMUs."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template
from typing import Any
from xml.etree.ElementTree import Element, SubElement, fromstring, indent, tostring

from cosim.core.units import DISPLAY, unit_definitions
from cosim.fmi.ports import Port
from cosim.fmi.sampled import AUTHOR, FRAME, TOOL
from cosim.model.model import AUTO, RK4, STIFF, Model
from cosim.model.traits import Traits

LICENCE = "MIT"
ASSETS = Path(__file__).resolve().parent / "assets"
NEEDS = "<p>Integration: {method} in equal substeps of at most {substep:g} ms, with constant inputs.</p>"
METHOD = {AUTO: "RK4", RK4: "RK4", STIFF: "RODAS, linearly implicit,"}
SWITCHES = (
    "<p>Parameters with a dot, <code>effect.parameter</code>, switch on effects that the base model lacks. At their\n"
    "start value an effect is dormant and costs nothing.</p>"
)
OF_FMI = ("input", "output", "parameter")  # causalities; other variables are local
KINDS3 = {"Real": "Float64", "Boolean": "Boolean", "String": "String"}


@dataclass(frozen=True)
class Description:
    """Content of a model description apart from names and start values of variables.

    Attributes:
        sampled: Name of the parameter with the only accepted communication step [s]; "" for any step.
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
    """Return pythonfmu's model description with all missing content added."""
    root: Any = fromstring(xml)
    root.attrib.pop("generationDateAndTime", None)  # Equal sources must give equal bytes.
    interface, categories = root.find("CoSimulation"), root.find("LogCategories")
    interface.attrib |= {
        "canHandleVariableCommunicationStepSize": str(about.variable_step).lower(),
        "canGetAndSetFMUstate": "true",
        "canSerializeFMUstate": "true",
    }
    root[:] = [interface]
    return described(root, categories, about, version, guid)


def described(
    root: Element,
    categories: Element,
    about: Description,
    version: str,
    guid: str,
    *,
    fmi: int = 2,
    state: str = "json",
    locals: Sequence[Port] = (),
    dependencies: Mapping[str, Sequence[str]] | None = None,
) -> bytes:
    """Return a complete model description, built on a root element that has the interfaces.

    Args:
        categories: Log categories.
        state: Format of the serialized FMU state.
        locals: Variables of native FMUs.
        dependencies: Dependencies of outputs and derivatives; by default those of `about`.
    """
    variables = (*about.ports, *locals)
    root.attrib |= {
        "guid" if fmi == 2 else "instantiationToken": guid,
        "description": about.description,
        "author": AUTHOR,
        "version": version,
        "license": LICENCE,
        "copyright": AUTHOR,
        "variableNamingConvention": naming_convention(v.name for v in variables),
    }
    times = {"startTime": "0", "stopTime": repr(about.stop), "stepSize": repr(about.step), "tolerance": "1e-6"}
    content = [unit_definitions({v.unit for v in variables if v.unit}), categories, Element("DefaultExperiment", times)]
    annotations = _annotations(about, state)
    for annotation in annotations if fmi == 2 else ():  # FMI demands a single element in each
        content.append(Element("VendorAnnotations"))
        SubElement(content[-1], "Tool", name=TOOL).append(annotation)
    content.append(model_variables(variables, fmi))
    content.append(model_structure(variables, dependencies or about.dependencies, about.initial_dependencies, fmi))
    if annotations and fmi == 3:
        content.append(Element("Annotations"))
        for annotation in annotations:
            SubElement(content[-1], "Annotation", type=TOOL).append(annotation)
    root.extend(content)
    indent(root)
    text: bytes = tostring(root, encoding="UTF-8", xml_declaration=True)
    return text + b"\n"


def _annotations(about: Description, state: str) -> list[Element]:
    """Return cosim's vendor annotations: traits of the model, and the accepted step."""
    annotations = []
    if traits := about.traits:
        annotations.append(node := Element("Traits", state=state))
        for name, rate in traits.rates.items():
            SubElement(node, "Rate", of=name, signal=rate)
        for name, (low, high) in traits.bounds.items():
            SubElement(node, "Limits", of=name, low=repr(low), high=repr(high))
        if traits.planar:
            SubElement(node, "PlanarFrame", {key: getattr(traits.planar, key) for key in FRAME})
    if about.sampled:
        annotations.append(node := Element("Sampled", parameter=about.sampled))
        if optional := " ".join(port.name for port in about.ports if port.optional):
            node.set("optional", optional)
    return annotations


def set_unit_and_limits(node: Element, unit: str, bounds: tuple[float, float] = (-math.inf, math.inf)) -> None:
    """Set unit, display unit and finite limits of a variable."""
    if unit:
        node.set("unit", unit)
        if display := DISPLAY.get(unit):
            node.set("displayUnit", display[0])
    for name, limit in zip(("min", "max"), bounds, strict=True):
        if math.isfinite(limit):
            node.set(name, repr(float(limit)))


def model_variables(variables: Sequence[Port], fmi: int = 2) -> Element:
    """Return ModelVariables, without event indicators in FMI 2.0."""
    root = Element("ModelVariables")
    if fmi == 3:  # FMI 3.0 requires the time.
        reference = str(len(variables))
        head = {"name": "time", "valueReference": reference, "causality": "independent", "variability": "continuous"}
        SubElement(root, "Float64", head)
    states = iter([k for k, v in enumerate(variables) if v.causality == "state"])  # in the order of the derivatives
    for k, v in enumerate(variables):
        if v.causality == "indicator" and fmi == 2:
            continue
        head = {"name": v.name, "valueReference": str(k), **({"description": v.doc} if v.doc else {})}
        head["causality"] = v.causality if v.causality in OF_FMI else "local"
        is_continuous = v.kind == "Real" and v.causality != "memory"
        head["variability"] = "continuous" if is_continuous else "discrete"
        if v.causality == "parameter":
            head |= {"variability": "fixed", "initial": "exact"}
        elif v.causality != "input":
            head["initial"] = "calculated"
        node = SubElement(root, KINDS3[v.kind] if fmi == 3 else "ScalarVariable", head)
        node = SubElement(node, v.kind) if fmi == 2 else node
        if v.kind == "Real":
            set_unit_and_limits(node, v.unit, v.bounds)
        if v.causality == "derivative":
            node.set("derivative", str(next(states) + (fmi == 2)))  # FMI 2.0 counts variables from 1.
        if v.causality not in ("input", "parameter"):
            continue
        start = v.start
        if not isinstance(start, str):
            start = str(start).lower() if isinstance(start, bool) else repr(float(start))
        if v.kind == "String" and fmi == 3:
            SubElement(node, "Start", value=start)
        else:
            node.set("start", start)
    return root


def model_structure(
    variables: Sequence[Port],
    dependencies: Mapping[str, Sequence[str]],
    starting: Mapping[str, Sequence[str]],
    fmi: int = 2,
) -> Element:
    """Return ModelStructure.

    Args:
        dependencies: Dependencies of outputs and derivatives.
        starting: Dependencies of outputs during initialization.
    """
    numbers = {v.name: k + (fmi == 2) for k, v in enumerate(variables)}
    outputs, states, rates, indicators = (
        [v.name for v in variables if v.causality == kind] for kind in ("output", "state", "derivative", "indicator")
    )
    unknowns: tuple[tuple[str, str, Mapping[str, Sequence[str] | None]], ...] = (
        ("Outputs", "Output", {n: dependencies[n] for n in outputs}),
        ("Derivatives", "ContinuousStateDerivative", {n: dependencies[n] for n in rates}),
        (
            "InitialUnknowns",
            "InitialUnknown",
            {**{n: starting[n] for n in outputs}, **dict.fromkeys((*states, *rates))},
        ),
        ("", "EventIndicator", dict.fromkeys(indicators)),
    )
    structure = Element("ModelStructure")
    for group, tag, sources in unknowns:
        if fmi == 2 and not (group and sources):
            continue
        parent = SubElement(structure, group) if fmi == 2 else structure
        for name, names in sources.items():
            number = {"index" if fmi == 2 else "valueReference": str(numbers[name])}
            node = SubElement(parent, "Unknown" if fmi == 2 else tag, number)
            if names is not None:
                node.set("dependencies", " ".join(map(str, sorted(numbers[n] for n in names))))
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
    page = Template((ASSETS / "page.html").read_text(encoding="utf-8")).substitute(
        title=title,
        version=escape(version),
        way=way,
        step=about.step,
        author=AUTHOR,
        licence=LICENCE,
        guid=guid,
        text=text + tables,
    )
    return {"index.html": page.encode(), "license.txt": (ASSETS / "license.txt").read_bytes()}
