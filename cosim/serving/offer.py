"""The FMUs that a server offers: files within folders named at its start."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cosim.base.errors import CosimError, FmuError
from cosim.blocks.description import read_description
from cosim.blocks.wire import LinkError
from cosim.serving import messages
from cosim.storage.archive import description_of

MOST_NAMES = 10  # in a message


class Offer:
    """FMUs by their names within folders."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self.folders = [folder.resolve() for folder in folders]

    def names(self) -> list[str]:
        """Return the names of all FMUs."""
        found = {p.relative_to(f).as_posix() for f in self.folders for p in f.rglob("*.fmu") if self._is_inside(p, f)}
        return sorted(found)

    def find(self, fmu: str, sha256: str | None) -> tuple[Path, str]:
        """Return file and SHA-256 of an FMU.

        Raises:
            LinkError: No file or several files fit.
        """
        is_name = fmu.endswith(".fmu") and ".." not in Path(fmu).parts
        paths = [f / fmu for f in self.folders if is_name and self._is_inside(f / fmu, f)]
        found = {hashlib.sha256(path.read_bytes()).hexdigest(): path for path in reversed(paths)}
        if not found:
            names = self.names()
            more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
            listed = (", ".join(names[:MOST_NAMES]) or "none") + more
            raise LinkError(messages.NOT_OFFERED(fmu=fmu, names=listed), "fmu", 2)
        if sha256 is not None and sha256 not in found:
            raise LinkError(messages.OTHER_CONTENT(fmu=fmu), "fmu", 2)
        if sha256 is None and len(found) > 1:
            raise LinkError(messages.AMBIGUOUS(fmu=fmu), "fmu", 2)
        digest = sha256 or next(iter(found))
        return found[digest], digest

    def describe(self, fmu: str, sha256: str | None) -> dict[str, Any]:
        """Return model description and SHA-256 of an FMU; raise LinkError if it cannot be used."""
        path, digest = self.find(fmu, sha256)
        try:
            read_description(path)
            content = description_of(path)
        except FmuError as error:
            raise invalid(fmu, path, error) from None
        return {"description": content, "sha256": digest}

    @staticmethod
    def _is_inside(path: Path, folder: Path) -> bool:
        """Return whether a file lies in a folder, also after links are followed."""
        try:
            return path.resolve().is_relative_to(folder) and path.is_file()
        except (OSError, ValueError):
            return False


def invalid(fmu: str, path: Path, error: CosimError) -> LinkError:
    """Return the error of an unusable FMU, without the place of its file."""
    return LinkError(messages.INVALID.around(str(error).replace(str(path), fmu), fmu=fmu), "fmu", 3)
