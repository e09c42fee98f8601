"""Keeps what others made from doing harm while it is read, and their tools' words from reaching the user raw."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cosim.base.errors import FmuError
from cosim.storage.archive import BadArchive, check_archive, check_identifier

WRAPPED = re.compile(r"Fatal py exception encountered: \[\w+\] \w+ (?P<kind>\w+)\((?P<text>.*?),?\)$")  # pythonfmu's
EXPERIMENT, BOUNDS = ("startTime", "stopTime", "stepSize", "tolerance"), ("min", "max")
CONVERSION = ("kg", "m", "s", "A", "K", "mol", "cd", "rad", "factor", "offset")
PLAIN = ("RuntimeError", "ValueError", "ArithmeticError", "Exception")


def check_fmu_file(path: Path) -> None:
    """FmuError where the archive would fill the disk, leave its folder, or is none."""
    try:
        check_archive(path)
    except BadArchive as error:
        raise FmuError(f"{path} is no FMU: {error}") from None
    except OSError as error:
        raise FmuError(f"{path} cannot be read: {error.strerror}") from None


def reason_of(error: Exception) -> str:
    """Why FMPy does not take a description, in a line, without the names of Python."""
    if isinstance(error, (TypeError, AttributeError, LookupError, UnboundLocalError, ArithmeticError)):
        return "its modelDescription.xml lacks what FMI demands, or has it in the wrong place"
    if isinstance(error, ValueError):
        return "a value in its modelDescription.xml is of the wrong kind"
    return " ".join(str(error).split())[:2000]


def check_identifiers(path: Path, description: Any) -> None:
    """FmuError where the name of a library leads out of the FMU."""
    try:
        for way in filter(None, (description.coSimulation, description.modelExchange)):
            check_identifier(way.modelIdentifier)
    except BadArchive as error:
        raise FmuError(f"{path} is not a valid FMU: {error}") from None


def check_numbers(path: Path, description: Any) -> None:
    """FmuError where a description that breaks the schema has text in place of a number that is used here."""
    for whole, what, value in _numbers(description):
        try:
            int(value) if whole else float(value)
        except (TypeError, ValueError):
            said = f'{what} is "{str(value)[:60]}", which is no {"whole " if whole else ""}number'
            raise FmuError(f"{path} is not a valid FMU: {said}") from None


def _numbers(description: Any) -> Iterator[tuple[bool, str, Any]]:
    """Whether it is whole, what it is, and itself, of each number that is there."""
    of_parts: list[tuple[str, Any, tuple[str, ...]]] = []
    of_parts.append(("its default experiment", description.defaultExperiment, EXPERIMENT))
    for unit in description.unitDefinitions:
        of_parts += [(f"unit {unit.name}", part, CONVERSION) for part in (unit.baseUnit, *unit.displayUnits)]
    for part in (*description.typeDefinitions, *description.modelVariables):
        simple = description.fmiVersion == "1.0" and getattr(part, "type", "") in {"Real", "Integer", "Enumeration"}
        of_parts.append((part.name, part, (*BOUNDS, *(("start",) if simple else ()))))
    for what, part, names in of_parts:
        for name in names:
            value = getattr(part, name, None)
            if value is not None and value != "":
                yield False, f"{name} of {what}", value
    for type_ in description.typeDefinitions:
        yield from ((True, f"item {item.name} of {type_.name}", item.value) for item in type_.items or ())


def without_wrapping(words: str) -> str:
    """What an exception in an FMU made of Python says, without how pythonfmu and the interpreter wrap it."""
    wrapped = WRAPPED.match(words)
    if wrapped is None:
        return words
    kind, text = wrapped["kind"], wrapped["text"].strip("'\"")
    return re.sub(r"^(Runtime|Value|Arithmetic)Error: ", "", text if kind in PLAIN else f"{kind}: {text}")


def validation(path: Path) -> list[str]:
    """What FMPy's validation says of the names of variables and of the model structure."""
    import fmpy
    from fmpy.model_description import ValidationError

    try:
        fmpy.read_model_description(str(path), validate_variable_names=True, validate_model_structure=True)
    except ValidationError as error:
        return [" ".join(str(problem).split()) for problem in error.problems]
    except Exception as error:  # as in `read_description`
        return [reason_of(error)]
    return []
