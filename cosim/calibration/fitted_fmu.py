"""The FMU with fitted start values: a copy whose modelDescription.xml has them, where its library follows the file."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from xml.parsers import expat

import numpy as np

from cosim.core.drafts import draft_of
from cosim.core.errors import FmuError, SimulationError
from cosim.files.archive import DESCRIPTION, description_of
from cosim.residuals.drive import Drive

START = re.compile(rb"(\sstart\s*=\s*)(\"[^\"]*\"|'[^']*')")
TAG = re.compile(rb"<(?:[^>\"']|\"[^\"]*\"|'[^']*')*>")
TYPED = {"Float64", "Float32"}  # elements of FMI 3 that are variables themselves
EQUAL = 1e-9  # difference of outputs relative to their range


def write_copy(fmu: Path, values: Mapping[str, float], path: Path) -> None:
    """Write a copy of an FMU with other start values; every other byte and file stays, with its date and place.

    Raises:
        ValueError: A start value is not found.
    """
    text = description_of(fmu)
    places: dict[str, int] = {}  # variable → position of the element that holds its start value
    inside = ""

    def begin(tag: str, attributes: dict[str, str]) -> None:
        nonlocal inside
        if tag == "ScalarVariable":
            inside = attributes.get("name", "")
        elif tag in TYPED and "name" in attributes:
            places[attributes["name"]] = parser.CurrentByteIndex
        elif tag == "Real" and inside:
            places[inside] = parser.CurrentByteIndex

    def end(tag: str) -> None:
        nonlocal inside
        inside = "" if tag == "ScalarVariable" else inside

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = begin, end
    with suppress(expat.ExpatError):
        parser.Parse(text, True)
    for name in sorted(values, key=lambda name: -places.get(name, 0)):
        place = places.get(name, 0)
        tag = TAG.match(text, place)
        if name not in places or tag is None or not START.search(tag[0]):
            raise ValueError(f"the start value of {name} was not found in modelDescription.xml")
        number = repr(float(values[name])).encode()
        text = text[:place] + START.sub(rb'\g<1>"' + number + b'"', tag[0], count=1) + text[tag.end() :]
    with draft_of(path) as draft, zipfile.ZipFile(fmu) as old, zipfile.ZipFile(draft, "w") as new:
        for member in old.infolist():
            content = text if member.filename == DESCRIPTION else old.read(member)
            new.writestr(member, content, member.compress_type)


def why_no_copy(
    drive: Drive,
    values: Mapping[str, float],
    start: Mapping[str, float],
    path: Path,
    load: Callable[[Path], AbstractContextManager[Drive]],
) -> str | None:
    """Write a copy with other start values if its library follows them; return the reason if there is none.

    The copy is run without any of the values, and compared with the original that has them set.

    Args:
        drive: Drive of the original over a log.
        start: Start values of the log, for both runs.
        load: Function that returns a drive of an FMU over that log, as a context.
    """
    try:
        write_copy(drive.fmu, values, path)
    except ValueError as error:
        return str(error)
    wanted = drive.run(0, drive.log.rows - 1, {**start, **values})
    try:
        with load(path) as copy:
            actual = copy.run(0, drive.log.rows - 1, start)
    except (SimulationError, FmuError):
        actual = np.full_like(wanted, np.nan)
    span = np.ptp(wanted, axis=0) + 1e-300
    if np.all(np.abs(actual - wanted) <= EQUAL * np.maximum(span, np.abs(wanted).max(axis=0))):
        return None
    path.unlink(missing_ok=True)
    return "the library ignores the start values of modelDescription.xml, so a changed copy would still start as before"
