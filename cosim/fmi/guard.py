"""Protection against harmful or malformed FMUs, and plain messages for errors of foreign tools."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from typing import Any

from cosim.core.errors import FmuError
from cosim.core.units import SI
from cosim.files.archive import SHOWN

# form of pythonfmu's exceptions
WRAPPED = re.compile(r"Fatal py exception encountered: \[\w+\] \w+ (?P<kind>\w+)\((?P<text>.*?),?\)$")
EXPERIMENT, BOUNDS = ("startTime", "stopTime", "stepSize", "tolerance"), ("min", "max")
CONVERSION = (*SI, "factor", "offset")
_WORD = r"[A-Za-z_][A-Za-z_0-9]*(\[[0-9]+(,[0-9]+)*\])?"
PLAIN_NAME = re.compile(rf"{_WORD}(\.{_WORD})*")  # which every naming convention allows
PLAIN = ("RuntimeError", "ValueError", "ArithmeticError", "Exception")


def reason_of(error: Exception) -> str:
    """Return FMPy's reason in a line, without Python terms."""
    if isinstance(error, (TypeError, AttributeError, LookupError, UnboundLocalError, ArithmeticError)):
        return "its modelDescription.xml lacks what FMI demands, or has it in the wrong place"
    if isinstance(error, ValueError):
        return "a value in its modelDescription.xml is of the wrong kind"
    return " ".join(str(error).split())[:2000]


def check_identifiers(path: Path, description: Any) -> None:
    """Raise FmuError if a library name leads outside the FMU."""
    for way in filter(None, (description.coSimulation, description.modelExchange)):
        name = way.modelIdentifier
        if name is None or not re.fullmatch(r"[^/\\\x00-\x1f:]+", name) or name in {".", ".."}:
            reason = f'its modelIdentifier "{str(name)[:SHOWN]}" is no name of a file'
            raise FmuError(f"{path} is not a valid FMU: {reason}")


def check_numbers(path: Path, description: Any) -> None:
    """Raise FmuError for text in place of a needed number. Only descriptions with schema violations need this check."""
    parts: list[tuple[str, Any, tuple[str, ...]]] = [
        ("its default experiment", description.defaultExperiment, EXPERIMENT)
    ]
    for unit in description.unitDefinitions:
        parts += [(f"unit {unit.name}", part, CONVERSION) for part in (unit.baseUnit, *unit.displayUnits)]
    for part in (*description.typeDefinitions, *description.modelVariables):
        simple = description.fmiVersion == "1.0" and getattr(part, "type", "") in {"Real", "Integer", "Enumeration"}
        parts.append((part.name, part, (*BOUNDS, *(("start",) if simple else ()))))
    numbers: list[tuple[Any, str, Any]] = []
    for place, part, names in parts:
        numbers += [(float, f"{name} of {place}", getattr(part, name, None)) for name in names]
    for type_ in description.typeDefinitions:
        numbers += [(int, f"item {item.name} of {type_.name}", item.value) for item in type_.items or ()]
    for kind, place, value in numbers:
        try:
            if kind is int or value not in (None, ""):
                kind(value)
        except (TypeError, ValueError):
            what = "whole number" if kind is int else "number"
            message = f'{path} is not a valid FMU: {place} is "{str(value)[:60]}", which is no {what}'
            raise FmuError(message) from None


def without_wrapping(words: str) -> str:
    """Return the message of a Python exception without the text that pythonfmu adds."""
    match = WRAPPED.match(words)
    if match is None:
        return words
    kind, text = match["kind"], match["text"].strip("'\"")
    return re.sub(r"^(Runtime|Value|Arithmetic)Error: ", "", text if kind in PLAIN else f"{kind}: {text}")


def validation(path: Path) -> list[str]:
    """Return FMPy's findings on variable names and model structure."""
    import fmpy
    from fmpy.model_description import ValidationError

    are_plain = False
    with suppress(Exception):  # The second reading tells the reason.
        variables = fmpy.read_model_description(str(path), validate=False).modelVariables
        are_plain = all(PLAIN_NAME.fullmatch(v.name) for v in variables)
    try:
        # FMPy's parser needs some milliseconds for a name.
        fmpy.read_model_description(str(path), validate_variable_names=not are_plain, validate_model_structure=True)
    except ValidationError as error:
        return [" ".join(str(problem).split()) for problem in error.problems]
    except Exception as error:  # as in `read_description`
        return [reason_of(error)]
    return []
