"""The FMU with fitted start values: a copy whose modelDescription.xml has them, where its library follows the file."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np

from cosim.core.drafts import draft_of
from cosim.core.errors import FmuError, SimulationError
from cosim.files.archive import DESCRIPTION, description_of
from cosim.fmi.wrapping.wrapped_description import parsed, set_starts, xml_of
from cosim.residuals.drive import Drive

EQUAL = 1e-9  # difference of outputs relative to their range


def write_copy(fmu: Path, values: Mapping[str, float], path: Path) -> None:
    """Write a copy of an FMU with other start values; every other file stays, with its date and place.

    Raises:
        ValueError: A variable has no start value.
    """
    root = parsed(description_of(fmu))
    set_starts(root, values, fmu.name)
    with draft_of(path) as draft, zipfile.ZipFile(fmu) as old, zipfile.ZipFile(draft, "w") as new:
        for member in old.infolist():
            content = xml_of(root) if member.filename == DESCRIPTION else old.read(member)
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
