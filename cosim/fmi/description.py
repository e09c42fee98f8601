"""Model descriptions of FMUs, also with schema violations, and checks of whether an FMU can run."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal
from weakref import WeakKeyDictionary
from xml.etree import ElementTree

from cosim.core.errors import FmuError
from cosim.core.units import SI
from cosim.files.archive import MAX_MEMBER_CHARACTERS, BadArchive, check_archive, description_of
from cosim.fmi.fmi_types import DOUBLE_TYPES, element_names

# form of pythonfmu's exceptions
WRAPPED = re.compile(r"Fatal py exception encountered: \[\w+\] \w+ (?P<kind>\w+)\((?P<text>.*?),?\)$")
NUMBER_ATTRIBUTES = "|".join(("startTime", "stopTime", "stepSize", "tolerance", "min", "max", *SI, "factor", "offset"))
# schema violations by text in place of a number: of an item, of a start value of FMI 1.0, or of another attribute
ITEM_SLIP = r"Element '[^']*Item', attribute 'value': '(?P<text>[^']+)'"
START_SLIP = r"Element '[^']*(Real|Integer|Enumeration)', attribute 'start': '(?P<text>[^']+)'"
NUMBER_SLIP = rf"attribute '({NUMBER_ATTRIBUTES})': '(?P<text>[^']+)'"
_WORD = r"[A-Za-z_][A-Za-z_0-9]*(\[[0-9]+(,[0-9]+)*\])?"
PLAIN_NAME = re.compile(rf"{_WORD}(\.{_WORD})*")  # characters allowed by every naming convention
PLAIN_ERRORS = ("RuntimeError", "ValueError", "ArithmeticError", "Exception")


# -- protection against harmful or malformed FMUs --------------------------------------------------


def reason_of(error: Exception) -> str:
    """Return FMPy's error in one line, without terms of Python."""
    if isinstance(error, (TypeError, AttributeError, LookupError, UnboundLocalError, ArithmeticError)):
        return "a required element or attribute of its modelDescription.xml is missing or misplaced"
    if isinstance(error, ValueError):
        return "a value in its modelDescription.xml has the wrong type"
    return " ".join(str(error).split())[:2000]


def without_wrapping(words: str) -> str:
    """Return the message of an exception in a Python FMU without the text that pythonfmu adds to it."""
    match = WRAPPED.match(words)
    if match is None:
        return words
    kind, text = match["kind"], match["text"].strip("'\"")
    return re.sub(r"^(Runtime|Value|Arithmetic)Error: ", "", text if kind in PLAIN_ERRORS else f"{kind}: {text}")


def validation(path: Path, description: Any) -> list[str]:
    """Return FMPy's messages on the variable names and model structure of a parsed description."""
    import fmpy
    from fmpy.model_description import ValidationError

    # limited, since FMPy's parser needs milliseconds per name
    names = not all(PLAIN_NAME.fullmatch(v.name) for v in description.modelVariables)
    try:
        fmpy.read_model_description(str(path), validate_variable_names=names, validate_model_structure=True)
    except ValidationError as error:
        return [" ".join(str(problem).split()) for problem in error.problems]
    except Exception as error:  # as in `read_description`
        return [reason_of(error)]
    return []


Way = Literal["co-simulation", "model-exchange", "scheduled-execution"]
INTERFACE_ATTRIBUTES: dict[Way, str] = {
    "co-simulation": "coSimulation",
    "model-exchange": "modelExchange",
    "scheduled-execution": "scheduledExecution",
}  # of FMPy's description
BINARIES_PREFIX, SOURCES_PREFIX = "binaries/", "sources/"
LIBRARY_ENDINGS = (".so", ".dll", ".dylib")
C_ENDINGS, CPP_ENDINGS = (".c",), (".cpp", ".cc", ".cxx", ".c++")
C_CODE = "c-code"  # name of the source platform in FMI
MAX_ARRAY_ELEMENTS = 1_000_000  # elements of an array; each gets a name
_slips: WeakKeyDictionary[Any, tuple[str, ...]] = WeakKeyDictionary()


def read_description(path: Path) -> Any:
    """Return FMPy's model description of a runnable FMU.

    Violations of the schema alone are accepted; see `slips_of`.

    Raises:
        FmuError: The FMU is invalid or cannot be run.
    """
    import fmpy

    from cosim.fmi.unread_attributes import add_unread_attributes

    try:
        check_archive(path)
    except BadArchive as error:
        raise FmuError(f"{path} is not an FMU: {error}") from None
    except OSError as error:
        raise FmuError(f"{path} cannot be read: {error.strerror}") from None
    slips: tuple[str, ...] = ()
    try:
        try:
            description = fmpy.read_model_description(str(path))
        except fmpy.model_description.ValidationError as error:
            description, slips = fmpy.read_model_description(str(path), validate=False), tuple(error.problems)
    except Exception as error:  # FMPy raises bare Exceptions, lxml its own.
        raise FmuError(f"{path} is not a valid FMU: {reason_of(error)}") from None
    invalid = f"{path} is not a valid FMU: its"
    for part in filter(None, (description.coSimulation, description.modelExchange)):
        name = str(part.modelIdentifier)
        if part.modelIdentifier is None or not re.fullmatch(r"[^/\\\x00-\x1f:]+", name) or name in {".", ".."}:
            # a library name that may lead outside the FMU
            raise FmuError(f'{invalid} modelIdentifier "{name[:MAX_MEMBER_CHARACTERS]}" is not a file name')
    patterns = (ITEM_SLIP, NUMBER_SLIP, *([START_SLIP] if description.fmiVersion == "1.0" else []))
    for slip, match in ((slip, match) for slip in slips for p in patterns if (match := re.search(p, slip))):
        try:
            (int if match.re.pattern == ITEM_SLIP else float)(match["text"])
        except ValueError:
            raise FmuError(f"{path} is not a valid FMU: {' '.join(slip.split())}") from None
    for variable in description.modelVariables:
        if variable.shape and not 0 <= math.prod(variable.shape) <= MAX_ARRAY_ELEMENTS:
            size = "×".join(map(str, variable.shape))
            raise FmuError(f"{invalid} array {variable.name} is {size}, not 0 … {MAX_ARRAY_ELEMENTS:g} elements")
    if not ways(description):
        raise FmuError(
            f"{path} is FMI {description.fmiVersion}, without a supported interface: FMI 1.0, 2.0 and 3.0 for "
            "co-simulation or model exchange, and 3.0 for scheduled execution"
        )
    if description.guid is None:
        attribute = "instantiationToken" if description.fmiVersion.startswith("3") else "guid"
        raise FmuError(
            f"{invalid} modelDescription.xml has no {attribute}, which its library needs for loading; export the FMU "
            "again"
        )
    add_unread_attributes(path, description)
    _slips[description] = slips
    return description


def slips_of(description: Any) -> tuple[str, ...]:
    """Return messages on violations of FMI's schema or rules that cosim accepts."""
    return _slips.get(description, ())


def ways(description: Any) -> tuple[Way, ...]:
    """Return the usable interfaces (co-simulation, model exchange, …), the preferred one first."""
    version = description.fmiVersion
    if version not in {"1.0", "2.0", "3.0"} and not version.startswith("3.0."):
        return ()
    return tuple(way for way, part in INTERFACE_ATTRIBUTES.items() if getattr(description, part) is not None)


def state_names(description: Any) -> list[str]:
    """Return the names of the continuous states.

    FMI 1.0 does not list states. In FMI 1.0, a variable x counts as a state if there is a variable der(x).
    """
    if description.fmiVersion != "1.0":
        derivatives = (unknown.variable.derivative for unknown in description.derivatives)
        return [state.name for state in derivatives if state is not None]
    names = {v.name for v in description.modelVariables if v.type == "Real"}
    return [v.name for v in description.modelVariables if f"der({v.name})" in names and v.name in names]


def takes_any_step(description: Any) -> bool:
    """Return True if the FMU accepts communication steps of any length."""
    cosimulation = description.coSimulation
    return cosimulation is None or bool(cosimulation.canHandleVariableCommunicationStepSize)


def declares_slopes(path: Path, way: Way) -> bool:
    """Return True if an FMU declares directional derivatives for an interface."""
    tag = "CoSimulation" if way == "co-simulation" else "ModelExchange"
    # FMPy reads the attribute of FMI 2.0 only; FMI 3.0 has a plural s.
    parts = ElementTree.fromstring(description_of(path)).iterfind(tag)
    return any(part.get(f"providesDirectionalDerivative{s}") in ("true", "1") for part in parts for s in ("", "s"))


def platform_of(description: Any) -> str:
    """Return the name of this machine's platform in the FMU's version of FMI."""
    import fmpy

    return str(fmpy.platform_tuple if description.fmiVersion.startswith("3") else fmpy.platform)


def platforms_among(names: Sequence[str]) -> list[str]:
    """Return the platforms of an FMU by its file names. The list ends with `c-code` if C or C++ sources exist."""
    parts = (n.removeprefix(BINARIES_PREFIX).partition("/") for n in names if n.startswith(BINARIES_PREFIX))
    platforms = {platform for platform, _, file in parts if file.endswith(LIBRARY_ENDINGS)}
    sources = any(n.startswith(SOURCES_PREFIX) and n.lower().endswith((*C_ENDINGS, *CPP_ENDINGS)) for n in names)
    return [*sorted(platforms), *([C_CODE] if sources else [])]


def no_library(here: str, platforms: Sequence[str]) -> str:
    """Return a message that an FMU has no library for this platform, with the cure."""
    others = ", ".join(p for p in platforms if p not in (C_CODE, here))
    text = f"it has no library named as its modelIdentifier for {here}{f', only for {others}' if others else ''}"
    if C_CODE in platforms:
        text += "; to compile and run its sources, use --compile (in Python compile=True)"
    return text


def library_file(folder: Path, description: Any, identifier: str) -> Path:
    """Return the path that FMI prescribes for the library on this platform."""
    import fmpy

    return folder / "binaries" / platform_of(description) / f"{identifier}{fmpy.sharedLibraryExtension}"


def library_of(folder: Path, description: Any, identifier: str) -> tuple[Path, str] | None:
    """Return the library for this platform, and a warning if its file name is not the prescribed one."""
    library = library_file(folder, description, identifier)
    if library.is_file():
        return library, ""
    libraries = sorted(library.parent.glob(f"*{library.suffix}"))
    if len(libraries) != 1:
        return None
    return libraries[0], f"its library is {libraries[0].name}, its modelIdentifier {identifier}"


def matches(pattern: str, component: str, variable: str) -> bool:
    """Return True if a pattern with * matches `component.variable`. Brackets are literal, as in array names."""
    return fnmatchcase(f"{component}.{variable}", pattern.replace("[", "[[]"))


# -- units ----------------------------------------------------------------------------------------


def unit_definition(description: Any, unit: str | None) -> tuple[float, ...] | None:
    """Return the SI exponents, factor and offset of a unit that the FMU defines; otherwise None."""
    for definition in description.unitDefinitions:
        if definition.name == unit and definition.baseUnit is not None:
            base = definition.baseUnit
            return (*(float(getattr(base, name) or 0) for name in SI), float(base.factor), float(base.offset))
    return None


def enumeration_items(variable: Any) -> dict[str, int]:
    """Return the items of an enumeration, name → number; items without a name are omitted."""
    declared = variable.declaredType
    return {i.name: int(i.value) for i in (declared.items or () if declared else ()) if i.name}


def _inherited(variable: Any, attribute: str) -> Any:
    """Return an attribute of a variable; if the variable does not declare it, that of its type."""
    return getattr(variable, attribute) or getattr(variable.declaredType, attribute, None)


def is_difference(variable: Any) -> bool:
    """Return True if a variable is declared as a difference (relativeQuantity)."""
    own = variable.relativeQuantity
    return bool(_inherited(variable, "relativeQuantity") if own is None else own)


def unit_of(variable: Any) -> str:
    """Return the unit of a variable or of its type; "" if there is none."""
    return str(_inherited(variable, "unit") or "")


def display_unit_of(variable: Any) -> str:
    """Return the display unit of a variable or of its type; "" if there is none."""
    return str(_inherited(variable, "displayUnit") or "")


def display_units(descriptions: Iterable[Any]) -> dict[str, tuple[str, float, float]]:
    """Return unit → (name of the display unit, factor, offset): displayed value = factor·value + offset.

    A unit is left out if its variables declare different display units.
    """
    found: dict[str, set[tuple[str, float, float]]] = {}
    for description in descriptions:
        known = {(u.name, d.name): d for u in description.unitDefinitions for d in u.displayUnits}
        for variable in description.modelVariables:
            unit, name = unit_of(variable), display_unit_of(variable)
            display = known.get((unit, name))
            if display is None or unit == name or getattr(display, "inverse", False):
                continue
            factor, offset = float(display.factor), float(display.offset)
            if 0.0 < factor < math.inf and math.isfinite(offset):
                found.setdefault(unit, set()).add((name, factor, offset))
    return {unit: displays.pop() for unit, displays in found.items() if len(displays) == 1}


def states_of(description: Any) -> list[Any]:
    """Return the variables of the continuous states, in the order of the derivatives.

    The list is empty if the FMU does not declare them.
    """
    states = [unknown.variable.derivative for unknown in description.derivatives]
    return [] if None in states else states


def name_states(path: Path, description: Any, references: Sequence[int]) -> None:
    """Add the derivatives of states that have variables to an FMI 1.0 description.

    The variable itself is used, not an alias, because a negated alias shares its value reference but has the opposite
    sign.
    """
    from fmpy.model_description import ModelVariable, Unknown

    root = ElementTree.fromstring(description_of(path))
    aliases = {v.get("name") for v in root.iter("ScalarVariable") if v.get("alias", "noAlias") != "noAlias"}
    variables = {v.valueReference: v for v in description.modelVariables if v.type == "Real" and v.name not in aliases}
    for k, reference in enumerate(references, 1):
        state = variables.get(reference) or ModelVariable(name=f"state[{k}]", valueReference=reference, type="Real")
        rate = ModelVariable(name=f"der({state.name})", type="Real")
        rate.derivative = state
        description.derivatives.append(Unknown(variable=rate))


def reals(description: Any, causality: str) -> list[Any]:
    """Return the real outputs or the continuous real inputs, by `causality`."""
    variables = [v for v in description.modelVariables if v.causality == causality and v.type in DOUBLE_TYPES]
    return [v for v in variables if causality != "input" or v.variability in (None, "continuous")]


def scalars(variables: Sequence[Any]) -> tuple[str, ...]:
    """Return the names of the scalar elements of variables."""
    return tuple(name for v in variables for name in element_names(v))


def units_of(variables: Sequence[Any]) -> dict[str, str]:
    """Return element name → unit of variables."""
    return {name: unit_of(v) for v in variables for name in element_names(v)}
