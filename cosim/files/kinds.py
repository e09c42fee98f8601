"""Kinds of files and folders, for messages that name the right command."""

from __future__ import annotations

import re
import shlex
import zipfile
from contextlib import suppress
from pathlib import Path

from cosim.core.errors import InputError
from cosim.files.artefact import BINARY, LOG, TEXT, artefacts, folder_kind, kind_by_keys, of_kind
from cosim.files.files import open_bytes
from cosim.files.table import sources, suffixes
from cosim.files.yaml_file import YamlFile

KEYED_ENDINGS = {".yaml", ".yml", ".json"}  # endings for which the keys decide the kind
ROW = re.compile(r"\s*[-+]?[\d.]+(e[-+]?\d+)?\s*([,;\t ]|$)", re.I)
TIME_COLUMN_OR_KEY = re.compile(r'"?time\b|\w+:(\s|$)')
UTF_16 = b"\xff\xfe", b"\xfe\xff"
KIND_HEAD_BYTES = 1024  # examined bytes
UNREAD = "no command reads it; `cosim --help` lists the commands and their files"


def kind_by_form(path: Path) -> str | None:
    """Return the kind of a file from its first bytes or ending; None if the kind depends on the keys."""
    head, ending = b"", path.suffix.lower()
    with suppress(OSError, ValueError), open_bytes(path) as stream:
        head = stream.read(KIND_HEAD_BYTES)
    text = head.decode("utf-8", errors="replace").lstrip("\ufeff")
    members: list[str] = []
    if head.startswith(b"PK") and ending not in {".fmu", ".ssp", *suffixes()}:  # Excel files are ZIP archives, too.
        with suppress(OSError, ValueError, zipfile.BadZipFile, NotImplementedError), zipfile.ZipFile(path) as archive:
            members = archive.namelist()

    for a in artefacts():
        if a.member in members:
            return a.kind
        name, other = a.beside or ("", "")  # In formats other than CSV, the file with the rows has another suffix.
        is_rows = name.endswith(".csv") and path.stem == Path(name).stem and path.suffix in suffixes()
        if a.beside and (path.name == name or is_rows) and (path.parent / other).is_file():
            return a.kind
    if any(source.magic and head.startswith(source.magic) for source in sources()):
        return LOG  # `check` examines the columns later.
    if ending in suffixes():  # A loss of power can leave zero bytes in a CSV file.
        is_binary = ending == ".csv" and b"\0" in head.partition(b"\n")[0] and not head.startswith(UTF_16)
        return BINARY if is_binary else LOG
    for a in artefacts():
        if ending in a.endings:
            return a.kind
    if b"\0" in head and ending not in KEYED_ENDINGS and not head.startswith(UTF_16):
        return BINARY
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    begin, *rows = lines or [""]
    # a row of numbers, a column name or a key
    is_tabular = any(map(ROW.match, rows)) or TIME_COLUMN_OR_KEY.match(begin)
    return TEXT if head and ending not in KEYED_ENDINGS and not is_tabular else None


def next_step(kind: str, path: Path) -> str:
    """Return advice that names the command for a file of this kind."""
    artefact = of_kind(kind)
    return UNREAD if artefact is None else artefact.next_step.format(file=shell_path(path))


def kind_of(path: Path) -> str | None:
    """Return the kind of a file by form or keys; None if unknown."""
    kind = kind_by_form(path)
    with suppress(InputError):
        if kind is None and path.suffix.lower() in KEYED_ENDINGS:
            return kind_by_keys(YamlFile(path).root)
    return kind


def refuse_other(path: Path, kind: str | None, *wanted: str) -> None:
    """Raise InputError for a file of an unwanted kind. The message names the command for the file."""
    if kind is None or not path.is_file():
        return
    artefact = of_kind(kind)
    if {kind, artefact.taken_as if artefact is not None else kind}.isdisjoint(wanted):
        raise InputError.at(path, f"is {kind}, not {' or '.join(wanted)}: {next_step(kind, path)}")


def refuse_unreadable(path: Path, *wanted: str) -> None:
    """Raise InputError for a path that cannot be read as a file: missing, empty, a folder or a pipe."""
    kinds = " or ".join(wanted)
    try:
        if path.is_dir():
            refuse_folder(path, kinds)
            raise InputError.at(path, f"is a folder, not {kinds}; give a file")
        if not path.exists():
            raise InputError.at(path, f"no such file; give {kinds}")
        if not path.is_file():  # A pipe would block.
            raise InputError.at(path, "is not a regular file")
        if not path.stat().st_size:
            raise InputError.at(path, f"is empty; give {kinds}")
    except (OSError, ValueError):  # a name too long, a loop of links, or a folder without access
        raise InputError.at(path, f"no such file, or it cannot be read; give {kinds}") from None


def check_form(path: Path, *wanted: str) -> None:
    """Raise InputError if a file is unreadable, or if its first bytes or suffix exclude the wanted kinds."""
    refuse_unreadable(path, *wanted)
    refuse_other(path, kind_by_form(path), *wanted)


def check_given(path: Path, *wanted: str) -> None:
    """Raise InputError if a file is unreadable, or if its kind, also by its keys, is not one of the wanted kinds."""
    refuse_unreadable(path, *wanted)
    refuse_other(path, kind_of(path), *wanted)


def shell_path(path: Path) -> str:
    """Return a path, quoted if a shell requires quotes."""
    return shlex.quote(str(path))


def refuse_folder(path: Path, kinds: str) -> None:
    """Raise InputError for a folder that another command wrote; accept an incomplete folder of a wanted kind."""
    artefact = folder_kind(path)
    if artefact is not None and artefact.folder not in kinds:
        step = artefact.folder_step.format(file=shell_path(path))
        raise InputError.at(path, f"is {artefact.folder}, not {kinds}: {step}")
