"""Reading of SSP archives, or an SSD in a folder: nested systems become FMUs, start values and connections.

Every XML element has its line and column. A component or nested system has a place: the names of the enclosing systems
and its own name. An end of a connection is a place and the name of a connector there.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote, urlsplit
from xml.parsers import expat

from cosim.blocks.component import Signal
from cosim.core.errors import Fault, FmuError, InputError, refuse
from cosim.core.messages import with_prefix
from cosim.core.scratch import temporary_folder
from cosim.core.text import did_you_mean, unique_name
from cosim.core.units import SI
from cosim.files.archive import MOST_XML, SSP_CONTENTS, STRUCTURE, BadArchive, check_xml, unpack
from cosim.files.artefact import SSP as SSP_FILE
from cosim.files.kinds import check_form
from cosim.files.yaml_file import MOST_FAULTS, format_value
from cosim.fmi.description import is_difference, read_description, unit_definition, unit_of
from cosim.fmi.fmi_types import FLOAT_TYPES

SSP_NAMESPACES = {
    "http://ssp-standard.org/SSP1/SystemStructureDescription": "ssd",
    "http://ssp-standard.org/SSP1/SystemStructureCommon": "ssc",
    "http://ssp-standard.org/SSP1/SystemStructureParameterValues": "ssv",
    "http://ssp-standard.org/SSP1/SystemStructureParameterMapping": "ssm",
    "http://ssp-standard.org/SSP1/SystemStructureSignalDictionary": "ssb",
}


@dataclass
class Element:
    """An XML element.

    In its `tag`, the namespace has the prefix used by the SSP standard, whatever prefix the file uses.
    """

    file: Path
    tag: str
    attributes: dict[str, str]
    line: int
    column: int
    children: list[Element] = field(default_factory=list)

    def all(self, *tags: str) -> Iterator[Element]:
        """Yield all elements at a path of tags; outer tags match their first element only."""
        parent = self.first(*tags[:-1])
        return (child for child in (parent.children if parent else ()) if child.tag == tags[-1])

    def first(self, *tags: str) -> Element | None:
        """Return the first element at a path of tags, if any."""
        return next(self.all(*tags), None) if tags else self

    def descendants(self) -> Iterator[Element]:
        """Yield all nested elements at any depth."""
        for child in self.children:
            yield child
            yield from child.descendants()

    def get(self, name: str) -> str | None:
        """Return an attribute, if present."""
        return self.attributes.get(name)

    def fault(self, message: str) -> Fault:
        """Return a fault at the place of this element."""
        name = self.get("name")
        label = f'{self.tag} "{name[:60]}"' if name else self.tag
        return Fault(self.file, self.line, self.column, with_prefix(f"{label}: ", message))


@dataclass(frozen=True)
class Package:
    """Files of a package.

    Attributes:
        shown: File named by the user.
        folder: Base folder of relative names; with `packed`, names must stay inside.
    """

    shown: Path
    folder: Path
    structure: Path
    packed: bool

    def resolve(self, source: str) -> Path | str:
        """Return the file of a relative URI in the SSP, or a message that says why the URI is not allowed."""
        name, cure = source[:80], "put the file into resources/ and use that path"
        try:
            uri = urlsplit(source)
            within = self.folder.resolve()
            path = (within / unquote(uri.path)).resolve()
            if uri.scheme not in {"", "file"} or uri.netloc or (self.packed and not path.is_relative_to(within)):
                return f'"{name}" is outside the package; {cure}'
            return path if path.is_file() else f'no file "{name}" in it'
        except (OSError, ValueError):  # an impossible file name
            return f'"{name}" is not a file name'

    def element(self, path: Path) -> Element:
        """Return the root element of a file; raise InputError if it cannot be read or parsed."""
        label = path
        if self.packed:
            label = self.shown if path == self.structure else self.shown / path.relative_to(self.folder)
        try:
            return _parse(label, path.read_bytes())
        except BadArchive as error:
            raise InputError.at(label, str(error)) from None
        except OSError as error:
            raise InputError.at(label, f"cannot be read: {error.strerror}") from None


@contextmanager
def open_package(path: Path) -> Iterator[Package]:
    """Yield an unpacked package; raise InputError if it is invalid or unsafe."""
    check_form(path, SSP_FILE)
    if path.suffix.lower() == ".ssd":
        yield Package(path, path.parent, path, packed=False)
        return
    with temporary_folder("ssp") as scratch:
        folder = scratch.resolve()
        try:
            unpack(path, folder, SSP_CONTENTS)
        except BadArchive as error:
            raise InputError.at(path, f"is not an SSP: {error}") from None
        except OSError as error:
            raise InputError.at(path, f"cannot be unpacked: {error.strerror}") from None
        yield Package(path, folder, folder / STRUCTURE, packed=True)


def _parse(file: Path, text: bytes) -> Element:
    """Return the root of a document; raise BadArchive if invalid or unsafe."""
    if len(text) > MOST_XML:
        raise BadArchive(f"it exceeds the limit of {MOST_XML / 1e6:.0f} MB; split it")
    check_xml(file.name, text, "SSP")
    prefixes: list[dict[str, str]] = [{}]
    document = Element(file, "", {}, 0, 0)
    ancestors = [document]

    def start(name: str, attributes: dict[str, str]) -> None:
        own = {key.removeprefix("xmlns").removeprefix(":"): v for key, v in attributes.items() if key[:5] == "xmlns"}
        prefixes.append({**prefixes[-1], **own})
        prefix, _, local = name.rpartition(":")
        uri = prefixes[-1].get(prefix)
        # an undeclared prefix is assumed to be the standard's
        prefix = prefix if uri is None else SSP_NAMESPACES.get(uri, prefix or "?")
        place = parser.CurrentLineNumber, parser.CurrentColumnNumber + 1
        element = Element(file, f"{prefix}:{local}", attributes, *place)
        ancestors[-1].children.append(element)
        ancestors.append(element)

    def end(_: Any) -> None:
        ancestors.pop()
        prefixes.pop()

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(text, True)
    return document.children[0]


# -- content -------------------------------------------------------------------------------------------

Place = tuple[str, ...]
End = tuple[Place, str]
Definition = tuple[float, ...]  # exponents of kg, m, s, A, K, mol, cd, rad, then factor and offset
Units = Mapping[str, Definition]
Default = TypeVar("Default", float, None)

VERSIONS = ("1.0", "2.0")
FMU_TYPE = "application/x-fmu-sharedlibrary"
PARAMETER_SET = "application/x-ssp-parameter-set"
INTERFACE_KINDS = {"any": None, "CoSimulation": "co-simulation", "ModelExchange": "model-exchange"}
# vendor annotations of OSP and of OMSimulator
STEP_ATTRIBUTES = {"FixedStepAlgorithm": "baseStepSize", "FixedStepMaster": "stepSize"}
SENDERS = {"output", "calculatedParameter"}  # kinds of connectors
OTHER_TRANSFORMATIONS = (
    "ssc:BooleanMappingTransformation",
    "ssc:IntegerMappingTransformation",
    "ssc:EnumerationMappingTransformation",
)
NO_NAME = "it has no name; add one"
INTEGER_TYPES = ("Integer", *(f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)))
BOOLEANS = {"true": True, "1": True, "false": False, "0": False}
VALUE_TYPES = (*FLOAT_TYPES, *INTEGER_TYPES, "Boolean", "String", "Enumeration", "Binary")


@dataclass(frozen=True)
class LinearTransformation:
    """Transformation factor·value + offset of a connection; `exact` replaces any unit conversion."""

    factor: float = 1.0
    offset: float = 0.0
    exact: bool = False


@dataclass(frozen=True)
class Connector:
    """A connector of a component or system. Its `unit` is None if the file states none."""

    kind: str
    unit: str | None
    element: Element


@dataclass(frozen=True)
class Connection:
    """A connection from source to target in the system at the place `within`."""

    start: End
    end: End
    linear: LinearTransformation
    element: Element
    within: Place


@dataclass(frozen=True)
class Parameter:
    """A named value: a number, true or false, or text."""

    name: str
    value: Any
    unit: str | None
    units: Units
    element: Element
    linear: LinearTransformation = LinearTransformation()


@dataclass
class FmuPart:
    """An FMU of the system: name in scenarios, file, FMI interface, and start values with their XML elements."""

    name: str
    fmu: Path
    interface: str | None
    element: Element
    description: Any
    variables: dict[str, Any]
    start: dict[str, tuple[Any, Element]] = field(default_factory=dict)


class Reader:
    """Reader of values, which collects faults and warnings with their places."""

    def __init__(self) -> None:
        self.faults: list[Fault] = []
        self.warnings: list[str] = []

    def note(self, element: Element, message: str) -> None:
        """Record a fault of an element; raise InputError with all faults once there are too many."""
        self.faults.append(element.fault(message))
        if len(self.faults) >= MOST_FAULTS:
            raise InputError(self.faults)

    def warn(self, element: Element, message: str) -> None:
        """Record a warning on an element."""
        self.warnings.append(str(Fault(element.file, element.line, element.column, message)))

    def check_version(self, root: Element) -> None:
        """Record a fault for an unknown version of SSP."""
        if (version := root.get("version")) not in VERSIONS:
            self.note(root, f"version {format_value(version)} is not supported; supported: {' and '.join(VERSIONS)}")

    def number(self, element: Element, name: str, default: Default) -> float | Default:
        """Return the number in an attribute; the default if it is missing or faulty. A fault is recorded."""
        text = element.get(name)
        if text is None:
            return default
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            self.note(element, f"{name} {format_value(text)}: use a finite number")
            return default
        return value

    def linear(self, element: Element) -> LinearTransformation:
        """Return the linear transformation of a connection or a mapping."""
        exact = element.get("suppressUnitConversion") in {"true", "1"}
        for other in filter(None, map(element.first, OTHER_TRANSFORMATIONS)):
            self.note(other, "is not supported; use ssc:LinearTransformation, or map the value in the FMU")
        linear = element.first("ssc:LinearTransformation") or element.first("ssd:LinearTransformation")
        if linear is None:
            return LinearTransformation(exact=exact)
        return LinearTransformation(self.number(linear, "factor", 1.0), self.number(linear, "offset", 0.0), exact)

    def units_in(self, element: Element, tag: str) -> Units:
        """Return the units in a child of an element."""
        units: dict[str, Definition] = {}
        for unit in element.all(tag, "ssc:Unit"):
            base, name = unit.first("ssc:BaseUnit"), unit.get("name")
            if name and base is not None:
                numbers = [self.number(base, n, 1.0 if n == "factor" else 0.0) for n in (*SI, "factor", "offset")]
                units[name] = tuple(numbers)
                if numbers[-2] == 0.0:
                    self.note(base, "the factor of a unit cannot be 0; give another")
                    del units[name]
        return units

    def value(self, typed: Element) -> Any:
        """Return a typed value; None for a faulty value, after recording the fault."""
        kind, text = typed.tag.partition(":")[2], typed.get("value")
        if kind not in VALUE_TYPES or text is None:
            self.note(typed, "is not a known type with a value; arrays are not supported, bind their elements by name")
        elif kind in (*FLOAT_TYPES, *INTEGER_TYPES):
            number = self.number(typed, "value", None)
            if number is None or kind in FLOAT_TYPES:
                return number
            if number.is_integer():
                return int(text) if text.strip().lstrip("+-").isdigit() else int(number)  # exact above 2⁵³
            self.note(typed, f"value {format_value(text)}: use a whole number")
        elif kind == "Boolean" and text not in BOOLEANS:
            self.note(typed, f"value {format_value(text)}: use true or false")
        else:
            return BOOLEANS[text] if kind == "Boolean" else text
        return None

    def values(self, holder: Element, prefix: str = "") -> list[Parameter]:
        """Return the parameters of a parameter set."""
        units, values = self.units_in(holder, "ssv:Units"), list[Parameter]()
        for each in holder.all("ssv:Parameters", "ssv:Parameter"):
            name = each.get("name")
            typed = next((c for c in each.children if c.tag.startswith("ssv:")), None)
            if not name or typed is None:
                self.note(each, "it has no value; add one such as ssv:Real" if name else NO_NAME)
            elif (value := self.value(typed)) is not None:
                values.append(Parameter(prefix + name, value, typed.get("unit"), units, each))
        return values


def read_parameter_set(path: Path) -> list[Parameter]:
    """Return the parameters of an SSV file; raise InputError with every fault."""
    root, reader = Package(path, path.parent, path, packed=False).element(path), Reader()
    if root.tag != "ssv:ParameterSet":
        raise InputError([root.fault("the root element should be ssv:ParameterSet")])
    reader.check_version(root)
    values = reader.values(root)
    refuse(reader.faults)
    return values


class SspSystem(Reader):
    """The system of a package, flattened, without faulty parts. InputError is raised if the package has no system.

    Attributes:
        parts: FMUs by place.
        chains: End → connections that lead to it, one after the other.
        start, stop, step: Times [s], None if absent.
        element, experiment: XML elements of the system and of its times, for messages.
    """

    def __init__(self, package: Package) -> None:
        super().__init__()
        self.package = package
        self.systems: dict[Place, Element] = {}
        self.inner: defaultdict[Place, list[str]] = defaultdict(list)  # names of the elements of systems
        self.parts: dict[Place, FmuPart] = {}
        self.connectors: dict[End, Connector] = {}
        self.connections: list[Connection] = []
        # connection by its end; of two sources, a recorded fault, the first one is used
        self.into: dict[End, Connection] = {}
        self.bindings: list[tuple[Place, Element]] = []  # holders of parameters, the inner ones first
        root = package.element(package.structure)
        if root.tag != "ssd:SystemStructureDescription":
            raise InputError([root.fault("the root element should be ssd:SystemStructureDescription")])
        self.check_version(root)
        system, experiment = root.first("ssd:System"), root.first("ssd:DefaultExperiment")
        if system is None:
            raise InputError([*self.faults, root.fault("it has no ssd:System; add one")])
        self.element, self.experiment, self.name = system, experiment or root, root.get("name") or "system"
        self.description = system.get("description") or root.get("description") or ""
        self.units = self.units_in(root, "ssd:Units")
        self.read_system(system, ())
        for place, element in self.systems.items():
            self.read_connections(element, place)
        self.chains = {last.end: self.hops_to(last) for last in self.connections if self.into[last.end] is last}
        self.set_parameters()
        self.start, self.stop = (self.number(self.experiment, name, None) for name in ("startTime", "stopTime"))
        if self.stop is not None and self.stop <= (self.start or 0.0):
            cure = f"startTime {self.start or 0.0:g} s; give a later stopTime"
            self.note(self.experiment, f"stopTime {self.stop:g} s is not after {cure}")
            self.stop = None
        self.links = [*self.read_links()]
        self.step = self.read_step([holder for holder in (experiment, system, root) if holder])

    def read_step(self, holders: Iterable[Element]) -> float | None:
        """Return the communication step [s] of another tool's annotation, if any."""
        annotations = filter(None, (holder.first("ssd:Annotations") for holder in holders))
        for element in chain.from_iterable(each.descendants() for each in annotations):
            attribute = STEP_ATTRIBUTES.get(element.tag.rpartition(":")[2])
            if attribute and element.get(attribute) is not None:
                step = self.number(element, attribute, None)
                if step is not None and step <= 0.0:
                    self.note(element, f"{attribute} {step:g} s: a communication step must be above 0 s")
                    return None
                return step
        return None

    # -- systems and components -----------------------------------------------------------------

    def read_system(self, element: Element, place: Place) -> None:
        """Read connectors and elements of a system."""
        self.systems[place], names = element, self.inner[place]
        readers = {"ssd:Component": self.read_component, "ssd:System": self.read_system}
        self.read_connectors(element, place)
        listed = element.first("ssd:Elements")
        dictionaries = element.first("ssd:SignalDictionaries")
        children = [child for child in listed.children if child.tag != "ssd:Annotations"] if listed else []
        for child in (*children, *(dictionaries.children if dictionaries else ())):
            name, read = child.get("name"), readers.get(child.tag)
            if read is None:
                self.note(child, "is not supported in a system; supported: ssd:Component and ssd:System")
            elif not name or name in names:
                self.note(child, "another element has this name; rename one of them" if name else NO_NAME)
            else:
                names.append(name)
                read(child, (*place, name))
        self.bindings.append((place, element))

    def read_component(self, element: Element, place: Place) -> None:
        """Read a component and the description of its FMU."""
        self.read_connectors(element, place)
        self.bindings.append((place, element))
        kind, source, interface = (element.get(name) for name in ("type", "source", "implementation"))
        if (interface or "any") not in INTERFACE_KINDS:
            names = ", ".join(INTERFACE_KINDS)
            self.note(element, f"implementation {format_value(interface)} is not supported; supported: {names}")
        if (kind or FMU_TYPE) != FMU_TYPE:
            self.note(
                element,
                f"type {format_value(kind)} is not supported; use {FMU_TYPE}, or nested systems in this file",
            )
            return
        fmu = self.package.resolve(source) if source else "it has no source; name its FMU"
        if isinstance(fmu, str):
            self.note(element, fmu)
            return
        try:
            description = read_description(fmu)
        except FmuError as error:
            self.faults.append(replace(element.fault(str(error)), exit_code=error.exit_code))
            return
        variables = {v.name: v for v in description.modelVariables}
        name = re.sub(r"[^A-Za-z0-9_]", "_", "_".join(place))
        name = f"_{name}" if name[:1].isdigit() else name
        unique = unique_name(name, {part.name for part in self.parts.values()})
        interface = INTERFACE_KINDS.get(interface or "any")
        self.parts[place] = FmuPart(unique, fmu, interface, element, description, variables)
        for (at, connector_name), connector in self.connectors.items():
            if at == place and connector_name not in variables and connector.kind in {"input", "output", "parameter"}:
                hint = did_you_mean(connector_name, variables)
                self.note(connector.element, f"{fmu.name} has no such variable{hint}")

    def read_connectors(self, element: Element, place: Place) -> None:
        """Read the connectors of a system or component."""
        for each in element.all("ssd:Connectors", "ssd:Connector"):
            if not (name := each.get("name")):
                self.note(each, NO_NAME)
                continue
            if (place, name) in self.connectors:
                self.note(each, "another connector has this name; keep one of them")
            units = (child.get("unit") for child in each.children if child.tag.startswith("ssc:"))
            self.connectors[place, name] = Connector(each.get("kind") or "", next(filter(None, units), None), each)

    # -- connections ----------------------------------------------------------------------------

    def read_connections(self, system: Element, place: Place) -> None:
        """Read the connections of a system; ends are sorted by signal direction."""
        for element in system.all("ssd:Connections", "ssd:Connection"):
            ends: list[End] = []
            for side in ("start", "end"):
                # OMSimulator writes an empty name for the system itself.
                owner, connector = element.get(f"{side}Element") or None, element.get(f"{side}Connector")
                if not connector:
                    self.note(element, f"it has no {side}Connector; add it")
                    break
                ends.append((place if owner is None else (*place, owner), connector))
                if owner is not None and owner not in self.inner[place]:
                    hint = did_you_mean(owner, self.inner[place])
                    self.note(element, f"{side}Element {format_value(owner)} is not in its system{hint}")
                elif ends[-1] not in self.connectors:
                    hint = did_you_mean(connector, [name for at, name in self.connectors if at == ends[-1][0]])
                    message = f"{owner or 'its system'} has no connector {format_value(connector)}{hint}"
                    self.note(element, f"{side}Connector: {message}")
            if len(ends) < 2:
                continue
            if self.sends(ends[0], place) is False and self.sends(ends[1], place) is True:
                ends.reverse()  # The order of the ends in a file has no meaning.
            connection = Connection(ends[0], ends[1], self.linear(element), element, place)
            self.connections.append(connection)
            if (first := self.into.setdefault(connection.end, connection)) is not connection:
                texts = [".".join((*at[len(place) :], name)) for at, name in (ends[1], first.start, ends[0])]
                self.note(element, f"two sources for {texts[0]}: {texts[1]} and {texts[2]}; keep one")

    def sends(self, end: End, within: Place) -> bool | None:
        """Return True if an end is a source within a system, False for a sink; None if its kind is undecided."""
        connector = self.connectors.get(end)
        if connector is None or connector.kind not in {*SENDERS, "input", "parameter"}:
            return None
        return (connector.kind in SENDERS) != (end[0] == within)

    def read_links(self) -> Iterator[tuple[str, str, LinearTransformation | None, Element]]:
        """Yield each connection from an FMU output to an FMU input, with its conversion if not only of units."""
        for end, hops in self.chains.items():
            first, element = hops[0].start, hops[-1].element
            if end not in self.connectors or not {first[0], end[0]} <= self.parts.keys():
                continue
            factors = self.chain(self.signal(first), [(self.signal(hop.end), hop.linear) for hop in hops], element)
            connectors = filter(None, map(self.connectors.get, (first, *(hop.end for hop in hops))))
            is_plain = all(connector.unit is None for connector in connectors)
            is_plain = is_plain and all(hop.linear == LinearTransformation() for hop in hops)
            linear = None if factors is None or is_plain else LinearTransformation(*factors)
            source, target = (f"{self.parts[place].name}.{name}" for place, name in (first, end))
            yield source, target, linear, element

    def hops_to(self, last: Connection) -> list[Connection]:
        """Return the chain of connections that ends with `last`, from an FMU or an unconnected system connector."""
        hops = [last]
        while hops[0].start[0] not in self.parts:
            before = self.into.get(hops[0].start)
            if before is None or any(before is hop for hop in hops):
                break
            hops.insert(0, before)
        return hops

    def signal(self, end: End, *, is_variable: bool = False) -> Signal:
        """Return the signal of an end, in the unit of its connector, else (or with `is_variable`) of its variable."""
        part, connector = self.parts.get(end[0]), None if is_variable else self.connectors.get(end)
        variable = None if part is None else part.variables.get(end[1])
        unit = None if connector is None else connector.unit
        is_own = unit is None  # The units of a file are defined in this file.
        if unit is None:
            unit = "" if variable is None else unit_of(variable)
        definitions = self.units.get(unit), None if part is None else unit_definition(part.description, unit)
        # The variables at the ends decide whether a value at a connector of a system is a difference.
        is_relative = part is None or (variable is not None and is_difference(variable))
        return Signal(end[1], unit, definitions[is_own] or definitions[not is_own], relative=is_relative)

    def chain(
        self, signal: Signal, stages: Iterable[tuple[Signal, LinearTransformation]], element: Element
    ) -> tuple[float, float] | None:
        """Return factor and offset of a chain of unit conversions and transformations."""
        factor, offset = 1.0, 0.0
        for target, linear in stages:
            unit = (1.0, 0.0) if linear.exact else signal.conversion(target)
            if unit is None:
                message = f"unit mismatch: [{signal.unit}] to [{target.unit}]. To pass the number unchanged, add "
                self.note(element, f'{message}suppressUnitConversion="true"')
                return None
            factor *= unit[0] * linear.factor
            offset = offset * (unit[0] * linear.factor) + (unit[1] * linear.factor + linear.offset)
            signal = target if target.unit or linear.exact else signal
        return factor, offset

    # -- parameters -----------------------------------------------------------------------------

    def set_parameters(self) -> None:
        """Set start values. Outer values override inner ones; in the same place the last value is used."""
        for place, holder in self.bindings:
            for parameter in self.parameters(holder):
                if place not in self.parts and place not in self.systems:
                    continue  # the FMU is unreadable
                targets = list(self.targets(place, parameter.name))
                for end, hops in targets:
                    self.set_start(end, parameter, hops)
                if not targets:
                    name = format_value(parameter.name)
                    self.warn(parameter.element, f"parameter {name} matches no variable and is ignored")

    def targets(self, place: Place, name: str) -> Iterator[tuple[End, Sequence[Connection]]]:
        """Yield the FMU variables of a hierarchical name, with the connections from a system's connector to them."""
        if place in self.parts:
            if name in self.parts[place].variables:
                yield (place, name), ()
            return
        for end, hops in self.chains.items() if (place, name) in self.connectors else ():
            first = next((k for k, hop in enumerate(hops) if hop.start == (place, name) and hop.within == place), None)
            inner = [] if first is None else hops[first:]
            is_variable = end[0] in self.parts and end[1] in self.parts[end[0]].variables
            if inner and is_variable and all(hop.end[0] != hop.within for hop in inner):
                yield end, inner
        for element in self.inner[place]:
            if name.startswith(f"{element}."):
                yield from self.targets((*place, element), name[len(element) + 1 :])

    def set_start(self, end: End, parameter: Parameter, hops: Sequence[Connection]) -> None:
        """Set a start value of an FMU, converted to the unit of the variable.

        Args:
            hops: Connections between systems that the value passes on its way from the parameter to the FMU.
        """
        part, value, unit = self.parts[end[0]], parameter.value, parameter.unit or ""
        if not isinstance(value, (bool, str)):
            units = {**self.units, **parameter.units}
            if unit not in units and unit.startswith("[") and unit.endswith("]"):  # some tools write units in brackets
                unit = unit[1:-1]
            # the variable decides whether the offset of the unit applies
            given = Signal(parameter.name, unit, units.get(unit), relative=True)
            first = self.signal(hops[0].start) if hops else self.signal(end, is_variable=True)
            stages = [(first, parameter.linear), *((self.signal(hop.end), hop.linear) for hop in hops)]
            factors = self.chain(given, stages, parameter.element)
            if factors is None:
                return
            value = value if factors == (1.0, 0.0) else value * factors[0] + factors[1]
        part.start[end[1]] = value, parameter.element

    def parameters(self, element: Element) -> Iterator[Parameter]:
        """Yield the bound parameters of an element under their mapped names."""
        for binding in element.all("ssd:ParameterBindings", "ssd:ParameterBinding"):
            if (kind := binding.get("type") or PARAMETER_SET) != PARAMETER_SET:
                self.note(binding, f"type {format_value(kind)} is not supported; use {PARAMETER_SET}")
                continue
            holder = self.content(binding, "ssd:ParameterValues", "ssv:ParameterSet")
            if holder is None:
                continue
            values = self.values(holder, binding.get("prefix") or "")
            mapping = binding.first("ssd:ParameterMapping")
            yield from values if mapping is None else self.mapped(mapping, values)

    def content(self, element: Element, *path: str) -> Element | None:
        """Return inline content or the root of the referenced file; None after recording a fault."""
        source, tag = element.get("source"), path[-1]
        if source is None:
            if (inline := element.first(*path)) is None:
                self.note(element, f"it has neither a source nor an inline {tag}; add one")
            return inline
        if (base := element.get("sourceBase") or "SSD") != "SSD":
            self.note(element, f"sourceBase {format_value(base)} is not supported; extract the file from the FMU")
            return None
        file = self.package.resolve(source)
        if isinstance(file, str):
            self.note(element, file)
            return None
        try:
            root = self.package.element(file)
        except InputError as error:
            self.faults += error.faults
            return None
        if root.tag != tag:
            self.note(root, f"the root element should be {tag}")
            return None
        self.check_version(root)
        return root

    def mapped(self, mapping: Element, values: list[Parameter]) -> Iterator[Parameter]:
        """Yield parameters renamed by a mapping; unmapped parameters are left out."""
        holder = self.content(mapping, "ssm:ParameterMapping")
        for entry in () if holder is None else holder.all("ssm:MappingEntry"):
            source, target = entry.get("source"), entry.get("target")
            if source == "" and target:  # a placeholder has no source
                continue
            if not source or not target:
                self.note(entry, f"it has no {'target' if source else 'source'}; add it")
                continue
            found, linear = [value for value in values if value.name == source], self.linear(entry)
            if not found:
                self.warn(entry, f"the parameter set has no {format_value(source)}")
            for value in found:
                if linear != LinearTransformation(exact=linear.exact) and isinstance(value.value, (bool, str)):
                    self.note(entry, f"a linear transformation of {format_value(value.value)}, which is not a number")
                else:
                    yield replace(value, name=target, linear=linear)
