"""Files of a system: an SSP archive, or an SSD in a folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote, urlsplit

from cosim.base.errors import Fault, InputError
from cosim.base.scratch import temporary_folder
from cosim.ssp.elements import Element, parse
from cosim.ssp.schema import slips
from cosim.storage.archive import SSP, STRUCTURE, BadArchive, unpack
from cosim.storage.kinds import SSP as SSP_FILE
from cosim.storage.kinds import check_form


@dataclass(frozen=True)
class Package:
    """Files of a package.

    Attributes:
        shown: File named by the user.
        folder: Base folder of relative names; with `packed`, names must stay inside.
        slips: Schema violations found while reading.
    """

    shown: Path
    folder: Path
    structure: Path
    packed: bool
    slips: list[Fault] = field(default_factory=list)

    def label(self, path: Path) -> Path:
        """Return the name of a file for messages."""
        if not self.packed:
            return path
        return self.shown if path == self.structure else self.shown / path.relative_to(self.folder)

    def resolve(self, source: str) -> Path | str:
        """Return the file of a relative URI in the SSP, or a message on a URI that is not allowed."""
        name = source[:80]
        try:
            uri = urlsplit(source)
            if uri.scheme not in {"", "file"} or uri.netloc:
                return f'"{name}" is not in the package; put the file into resources/ and name it so'
            within = self.folder.resolve()
            path = (within / unquote(uri.path)).resolve()
            if self.packed and not path.is_relative_to(within):
                return f'"{name}" leads out of the package; put the file into resources/ and name it so'
            return path if path.is_file() else f'no file "{name}" in it{self._hint(path)}'
        except (OSError, ValueError):  # an impossible file name
            return f'"{name}" is no name of a file'

    def _hint(self, path: Path) -> str:
        """Return a suggestion with the same name in different case."""
        folders = dict.fromkeys((path.parent, self.folder / "resources"))
        files = (p for folder in folders if folder.is_dir() for p in sorted(folder.iterdir()) if p.is_file())
        match = next((p for p in files if p.name.lower() == path.name.lower()), None)
        if match is None or not match.is_relative_to(self.folder):
            return ""
        return f'; did you mean "{match.relative_to(self.folder).as_posix()}"?'

    def element(self, path: Path) -> Element:
        """Return the root element of a file; raise InputError."""
        label = self.label(path)
        try:
            text = path.read_bytes()
            root = parse(label, text)
        except BadArchive as error:
            raise InputError.at(label, str(error)) from None
        except OSError as error:
            raise InputError.at(label, f"cannot be read: {error.strerror}") from None
        self.slips.extend(slips(label, text))
        return root


@contextmanager
def open_package(path: Path) -> Iterator[Package]:
    """Yield a package, unpacked during the block; raise InputError if invalid or unsafe."""
    check_form(path, SSP_FILE)
    if path.suffix.lower() == ".ssd":
        yield Package(path, path.parent, path, packed=False)
        return
    with temporary_folder("ssp") as scratch:
        folder = scratch.resolve()
        try:
            unpack(path, folder, SSP)
        except BadArchive as error:
            raise InputError.at(path, f"is no SSP: {error}") from None
        except OSError as error:
            raise InputError.at(path, f"cannot be unpacked: {error.strerror}") from None
        yield Package(path, folder, folder / STRUCTURE, packed=True)
