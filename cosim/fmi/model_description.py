"""Model descriptions, vendor annotations and documentation pages of FMUs built by cosim."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from string import Template
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from cosim.core.units import DISPLAY, unit_definitions
from cosim.core.version import __version__
from cosim.fmi.annotations import AUTHOR, TOOL
from cosim.fmi.ports import Port
from cosim.model.model import AUTO, RK4, STIFF, Model
from cosim.model.traits import Traits

LICENCE = "MIT"
ASSETS = Path(__file__).resolve().parent / "assets"
NEEDS = "<p>Integration: {method} in equal substeps of at most {substep:g} ms, with constant inputs.</p>"
METHOD = {AUTO: "RK4", RK4: "RK4", STIFF: "RODAS, linearly implicit,"}
EFFECTS_NOTE = (
    "<p>Parameters with a dot, <code>effect.parameter</code>, switch on effects that the base model lacks. At their\n"
    "start value an effect is off and takes no time.</p>"
)
OF_FMI = ("input", "output", "parameter")  # causalities of FMI; other causalities of a Port become `local`
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


# FMI's structured names without quotes: names joined by dots, perhaps with indices, or der(…) of such a name
_PART = r"[A-Za-z_][A-Za-z0-9_]*(\[\d+(,\d+)*\])?"
STRUCTURED = re.compile(rf"{_PART}(\.{_PART})*|der\({_PART}(\.{_PART})*\)", re.ASCII)


def describe(
    about: Description,
    name: str,
    tool: str,
    guid: str,
    interfaces: Mapping[str, dict[str, str]],
    categories: Mapping[str, str],
    *,
    fmi: int = 2,
    locals: Sequence[Port] = (),
    dependencies: Mapping[str, Sequence[str]] | None = None,
) -> bytes:
    """Return modelDescription.xml of FMI 2.0 or 3.0.

    Args:
        tool: Generation tool. For a native FMU it is cosim itself, and in FMI 2.0 `all.c` is then listed as source
            file.
        interfaces: Element of the interface → its attributes.
        categories: Log category → meaning.
        locals: Variables of native FMUs.
        dependencies: Dependencies of outputs and derivatives; by default those of `about`.
    """
    variables, is_native = (*about.ports, *locals), tool.startswith(TOOL)
    is_structured = all(STRUCTURED.fullmatch(v.name) for v in variables)
    head = {"fmiVersion": f"{fmi}.0", "modelName": name, "generationTool": tool}
    if fmi == 2 and is_native:
        head["numberOfEventIndicators"] = str(sum(v.causality == "indicator" for v in locals))
    head |= {"guid" if fmi == 2 else "instantiationToken": guid, "description": about.description, "author": AUTHOR}
    head |= {"version": __version__, "license": LICENCE, "copyright": AUTHOR}
    head["variableNamingConvention"] = "structured" if is_structured else "flat"
    root = Element("fmiModelDescription", head)
    for tag, attributes in interfaces.items():
        interface = SubElement(root, tag, attributes)
        if fmi == 2 and is_native:
            SubElement(SubElement(interface, "SourceFiles"), "File", name="all.c")
    root.append(unit_definitions({v.unit for v in variables if v.unit}))
    logging = SubElement(root, "LogCategories")
    for category, meaning in categories.items():
        SubElement(logging, "Category", name=category, description=meaning)
    times = {"startTime": "0", "stopTime": repr(about.stop), "stepSize": repr(about.step), "tolerance": "1e-6"}
    SubElement(root, "DefaultExperiment", times)
    annotations = []
    if traits := about.traits:
        annotations.append(node := Element("Traits", state="doubles" if is_native else "json"))
        for signal, rate in traits.rates.items():
            SubElement(node, "Rate", of=signal, signal=rate)
        for signal, (low, high) in traits.bounds.items():
            SubElement(node, "Limits", of=signal, low=repr(low), high=repr(high))
        if traits.planar:
            SubElement(node, "PlanarFrame", asdict(traits.planar))
    if about.sampled:
        annotations.append(node := Element("Sampled", parameter=about.sampled))
        if optional := " ".join(port.name for port in about.ports if port.optional):
            node.set("optional", optional)
    for annotation in annotations if fmi == 2 else ():  # FMI 2.0 requires a single element in each annotation
        SubElement(SubElement(root, "VendorAnnotations"), "Tool", name=TOOL).append(annotation)
    root.append(model_variables(variables, fmi))
    root.append(model_structure(variables, dependencies or about.dependencies, about.initial_dependencies, fmi))
    if annotations and fmi == 3:
        parent = SubElement(root, "Annotations")
        for annotation in annotations:
            SubElement(parent, "Annotation", type=TOOL).append(annotation)
    indent(root)
    text: bytes = tostring(root, encoding="UTF-8", xml_declaration=True)
    return text + b"\n"


def set_unit_and_limits(node: Element, unit: str, bounds: tuple[float, float] = (-math.inf, math.inf)) -> None:
    """Set unit, display unit and finite limits of a variable."""
    if unit:
        node.set("unit", unit)
        if display := DISPLAY.get(unit):
            node.set("displayUnit", display[0])
    for name, limit in zip(("min", "max"), bounds, strict=True):
        if math.isfinite(limit):
            node.set(name, repr(float(limit)))


def model_variables(variables: Sequence[Port], fmi: int) -> Element:
    """Return ModelVariables; event indicators are included in FMI 3.0 only."""
    root = Element("ModelVariables")
    if fmi == 3:  # FMI 3.0 requires time as a variable
        reference = str(len(variables))
        head = {"name": "time", "valueReference": reference, "causality": "independent", "variability": "continuous"}
        SubElement(root, "Float64", head)
    states = iter([k for k, v in enumerate(variables) if v.causality == "state"])  # ordered as the derivatives
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
            node.set("derivative", str(next(states) + (fmi == 2)))  # FMI 2.0 counts variables from 1
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
    fmi: int,
) -> Element:
    """Return ModelStructure.

    Args:
        dependencies: Dependencies of outputs and derivatives.
        starting: Dependencies of outputs during initialization.
    """
    is2, numbers = fmi == 2, {v.name: k + (fmi == 2) for k, v in enumerate(variables)}
    outputs, states, rates, indicators = (
        [v.name for v in variables if v.causality == kind] for kind in ("output", "state", "derivative", "indicator")
    )
    initial: dict[str, Sequence[str] | None] = {n: starting[n] for n in outputs}
    initial |= dict.fromkeys((*states, *rates))
    unknowns: list[tuple[str, str, Mapping[str, Sequence[str] | None]]] = [
        ("Outputs", "Output", {n: dependencies[n] for n in outputs}),
        ("Derivatives", "ContinuousStateDerivative", {n: dependencies[n] for n in rates}),
        ("InitialUnknowns", "InitialUnknown", initial),
        ("", "EventIndicator", {} if is2 else dict.fromkeys(indicators)),
    ]
    structure = Element("ModelStructure")
    for group, tag, sources in unknowns:
        parent = SubElement(structure, group) if is2 and sources else structure
        for name, names in sources.items():
            number = {"index" if is2 else "valueReference": str(numbers[name])}
            node = SubElement(parent, "Unknown" if is2 else tag, number)
            if names is not None:
                node.set("dependencies", " ".join(map(str, sorted(numbers[n] for n in names))))
    return structure


def docstrings_html(*owners: object) -> str:
    """Return the docstrings of modules or classes as HTML."""
    return "".join(f"<pre>{escape(inspect.getdoc(owner) or '')}</pre>" for owner in owners)


def model_text(model: Model) -> str:
    """Return a model's documentation as HTML: equations, effects, integration."""
    effects = "".join(f"<li><code>{k.name}</code>: {escape(k.equation)}</li>" for k in model.catalogue)
    catalogue = f"{EFFECTS_NOTE}<ul>{effects}</ul>" if effects else ""
    needs = NEEDS.format(method=METHOD[model.integrator], substep=1000 * model.substep)
    return docstrings_html(type(model), model.equations) + needs + catalogue


def documentation(about: Description, text: str, guid: str, way: str) -> dict[str, bytes]:
    """Return the files of the FMU's folder `documentation`: its page `index.html`, and the licence."""
    names = {"title": escape(about.description), "version": escape(__version__), "author": AUTHOR, "licence": LICENCE}
    page = Template((ASSETS / "page.html").read_text(encoding="utf-8")).substitute(
        names, way=way, step=about.step, guid=guid, text=text
    )
    licence = (ASSETS / "license.txt").read_bytes()
    return {"documentation/index.html": page.encode(), "documentation/license.txt": licence}
