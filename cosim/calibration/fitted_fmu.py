"""The FMU with fitted start values.

It is a copy whose modelDescription.xml has them, if its library follows the file. Else a wrapper sets them, as in a
refined FMU; that takes a compiler.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np

from cosim.core.drafts import draft_of
from cosim.core.errors import FmuError, SimulationError
from cosim.files.archive import DESCRIPTION, description_of
from cosim.fmi.native.compiler import CompilerFailed, NoCompiler
from cosim.fmi.wrapping.wrap import CannotWrap, parsed, set_starts, wrap, xml_of
from cosim.residuals.drive import Drive
from cosim.terms.code import TermCode

EQUAL = 1e-9  # difference of outputs relative to their range


def write_copy(fmu: Path, values: Mapping[str, float], path: Path) -> None:
    """Write a copy of an FMU with other start values; every other file stays, with its date and place.

    Raises:
        CannotWrap: A variable has no start value.
    """
    root = parsed(description_of(fmu))
    set_starts(root, values, fmu.name)
    with draft_of(path) as draft, zipfile.ZipFile(fmu) as old, zipfile.ZipFile(draft, "w") as new:
        for member in old.infolist():
            content = xml_of(root) if member.filename == DESCRIPTION else old.read(member)
            new.writestr(member, content, member.compress_type)


def deliver(
    drive: Drive,
    values: Mapping[str, float],
    start: Mapping[str, float],
    path: Path,
    load: Callable[[Path], AbstractContextManager[Drive]],
) -> tuple[str, str]:
    """Write an FMU with other start values that behaves as the original with these values set.

    It is run without setting any of the values, and compared.

    Args:
        drive: Drive of the original over a log.
        start: Start values of the log, for both runs.
        load: Function that returns a drive of an FMU over that log, as a context.

    Returns:
        How it was made, "copied", "wrapped" or "" if there is none; why it is not copied, or why there is none.
    """
    wanted, reason = drive.run(0, drive.log.rows - 1, {**start, **values}), ""
    span = np.maximum(np.ptp(wanted, axis=0) + 1e-300, np.abs(wanted).max(axis=0))
    for way, write in (("copied", write_copy), ("wrapped", _write_wrapped)):
        try:
            write(drive.fmu, values, path)
            with load(path) as made:
                actual = made.run(0, drive.log.rows - 1, start)
        except (CannotWrap, NoCompiler, CompilerFailed) as error:
            reason += f"{'; ' if reason else ''}{error}"
            continue
        except (SimulationError, FmuError):
            actual = np.full_like(wanted, np.nan)
        if np.all(np.abs(actual - wanted) <= EQUAL * span):
            return way, reason
        if way == "copied":
            reason = "the library ignores the start values of modelDescription.xml"
        else:
            reason += "; its wrapper, which sets the values, does not behave as the FMU with the values set"
    path.unlink(missing_ok=True)
    return "", reason


def _write_wrapped(fmu: Path, values: Mapping[str, float], path: Path) -> None:
    """Write an FMU that holds the original and sets start values."""
    wrap(fmu, TermCode("", (), hooks=()), values, path)
