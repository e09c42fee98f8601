"""What kind of file or folder one is, so that a command given another kind can say which reads it."""

from __future__ import annotations

import re
import shlex
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cosim.base.errors import Fault, InputError
from cosim.storage import artefact
from cosim.storage.table_source import suffixes
from cosim.storage.yaml_file import YamlFile

LOG, FMU, SSP, SCENARIO, MANIFEST, STUDY, MODEL, ANSWER, CODE, SWEEP, RESULTS, TABLE = (
    "a log", "an FMU", "an SSP", "a scenario", "a manifest", "a study", "a model file", "an answer of `cosim refine`",
    "a model's Python file", "a sweep", "the rows of a run", "a table of runs",
)  # fmt: skip
PAGE, PICTURE, NOTEBOOK, MATRICES, WORKBOOK, ARCHIVE, LIBRARY, DATABASE, SCHEMA, POINTER, TEXT, DOCUMENT = (
    "a page for a browser", "a picture", "a notebook", "a file of matrices", "a workbook",
    "an archive that holds no FMU", "a compiled library", "a database", "a JSON schema", "a pointer of Git LFS",
    "a text", "a PDF",
)  # fmt: skip
DESCRIPTION, BINARY = "XML", "a binary file"
UNREAD = "no command reads it; `cosim --help` lists what each takes"
OTHERS = {  # kinds that no verb declares: files of other tools, and what may be done with them
    PAGE: "a browser opens it; `cosim report FOLDER` makes that of a run again",
    PICTURE: "a browser opens it; `cosim graph SCENARIO` draws one",
    NOTEBOOK: "Jupyter opens it; in it, `import cosim`",
    MATRICES: "of its columns write a CSV, `time` first, and `cosim check` checks that",
    WORKBOOK: "save the sheet as CSV, `time` first, and `cosim check` checks that",
    ARCHIVE: "unpack it; `cosim info` lists an FMU that is in it",
    LIBRARY: "an FMU holds libraries; `cosim info` lists what an FMU has",
    DATABASE: "`cosim sweep SWEEP.yaml` goes on with one that it left, named with its --out",
    SCHEMA: "an editor reads it; `cosim schema` prints it",
    POINTER: "`git lfs pull` fetches the file itself; then `cosim check` checks it",
    DESCRIPTION: "`cosim info` lists what the FMU has that it is of",
    TEXT: UNREAD,
    DOCUMENT: UNREAD,
    BINARY: UNREAD,
}
AS = {RESULTS: LOG}  # taken wherever the other is
RUNS = "sweep.parquet"  # the table of runs; any other Parquet file is a log, or the rows of a run
HEADS = (  # first bytes of a file
    (b"\x89PNG", PICTURE), (b"\xff\xd8\xff", PICTURE), (b"GIF8", PICTURE), (b"%PDF-", DOCUMENT),
    (b"MATLAB", MATRICES), (b"\x89HDF\r\n", MATRICES), (b"\x7fELF", LIBRARY), (b"MZ", LIBRARY),
    (b"\xcf\xfa\xed\xfe", LIBRARY), (b"SQLite format 3\0", DATABASE), (b"\xd0\xcf\x11\xe0", WORKBOOK),
    (b"version https://git-lfs.", POINTER),
)  # fmt: skip
MARKS = (  # beginnings of a text
    (re.compile(r"<!doctype html|<html", re.I), PAGE),
    (re.compile(r"(<\?xml[^>]*>\s*)?(<!--.*?-->\s*|<!doctype[^>]*>\s*)*<svg\b", re.I | re.S), PICTURE),
    (re.compile(r"(<\?xml[^>]*>\s*)?<\w*:?SystemStructureDescription\b", re.S), SSP),
    (re.compile(r"<(\?xml|[A-Za-z][\w:]*[ >])"), DESCRIPTION),
)
ENDINGS = {".py": CODE, ".ssp": SSP, ".ssd": SSP, ".fmu": FMU, ".ipynb": NOTEBOOK, ".mat": MATRICES}
WRITTEN = {".yaml", ".yml", ".json"}  # whose keys say what they are
PROSE = {".md", ".rst", ".mmd", ".tex", ".c", ".h", ".toml", ".sh"}
COLUMNS = {"", ".txt", ".dat", ".tsv", ".log", ".asc"}  # text, or a table of some instrument
ROW = re.compile(r"\s*[-+]?[\d.]+(e[-+]?\d+)?\s*([,;\t ]|$)", re.I)
FIRST = re.compile(r'"?time\b|\w+:(\s|$)')
KEYED = re.compile(r'(?!time\b)\w+:(\s|$)|\{\s*"')
UTF_16 = b"\xff\xfe", b"\xfe\xff"
HEAD = 1024  # bytes


def kind_by_form(path: Path) -> str | None:
    """The kind of a file by its first bytes or its ending, whatever its case; None of one whose keys will say."""
    ending = path.suffix.lower()
    try:
        head = _head(path) if path.is_file() else b""
    except (OSError, ValueError):
        head = b""
    if head.startswith(b"PAR1") or (ending in suffixes() and ending != ".csv"):
        return TABLE if path.name == RUNS else _of_rows(path)
    kind = next((kind for magic, kind in HEADS if head.startswith(magic)), None)
    if kind is None and head.startswith(b"PK") and ending not in {".fmu", ".ssp"}:
        kind = _packed(path)
    if kind is None and ending not in WRITTEN:
        kind = _marked(head)
    if kind is not None:
        return kind
    if ending == ".csv":
        return _of_csv(path, head)
    if ending in ENDINGS or not head:
        return ENDINGS.get(ending)
    if b"\0" in head and ending not in WRITTEN and not head.startswith(UTF_16):
        return BINARY
    return TEXT if ending in PROSE or (ending in COLUMNS and not _tabular(head)) else None


def _of_rows(path: Path) -> str:
    """The kind of a table with a row a moment: what a run left, or a log."""
    return RESULTS if path.stem == "results" and (path.parent / "manifest.json").is_file() else LOG


def _of_csv(path: Path, head: bytes) -> str:
    """The kind of a file that ends as CSV does."""
    kind = _of_rows(path)
    if kind == LOG and _no_text(head):
        return BINARY
    return _by_keys(path) or LOG if kind == LOG and _keyed(head) else kind


def _head(path: Path) -> bytes:
    with path.open("rb") as stream:
        return stream.read(HEAD)


def _packed(path: Path) -> str | None:
    """The kind of an archive by what is in it; None of what only begins like one."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = set(archive.namelist())
    except (OSError, ValueError, zipfile.BadZipFile, NotImplementedError):
        return None
    if "modelDescription.xml" in names:
        return FMU
    if "SystemStructure.ssd" in names:
        return SSP
    return WORKBOOK if any(n.startswith("xl/") for n in names) else ARCHIVE


def _tabular(head: bytes) -> bool:
    """Whether a text may be a table or a mapping: it has a row of numbers, or begins with a column or a key."""
    lines = head.decode("utf-8", errors="replace").splitlines()
    return any(ROW.match(line) for line in lines[1:]) or bool(lines and FIRST.match(lines[0]))


def _no_text(head: bytes) -> bool:
    """Whether bytes are none of a text, in any encoding that loggers write; a zero here or there is a torn row."""
    if head.startswith(UTF_16):
        return False
    controls = sum(byte < 9 or 13 < byte < 32 for byte in head)
    return b"\0" in head.partition(b"\n")[0] or (controls > 0.05 * len(head) and any(byte > 127 for byte in head))


def _keyed(head: bytes) -> bool:
    """Whether a text begins as YAML or JSON does, with a key."""
    lines = (line.strip() for line in head.decode("utf-8", errors="replace").lstrip("\ufeff").splitlines())
    first = next((line for line in lines if line and not line.startswith(("#", "---", "%"))), "")
    return bool(first == "{" or KEYED.match(first))


def _marked(head: bytes) -> str | None:
    """The kind of a text that begins as XML does."""
    text = head.decode("utf-8", errors="replace").lstrip("\ufeff \t\r\n")
    return next((kind for mark, kind in MARKS if mark.match(text)), None)


def kind_by_keys(root: Any) -> str | None:
    """Return the kind of a YAML or JSON file by its keys; None where they do not say."""
    keys = set(root) if isinstance(root, dict) else set()
    if "nbformat" in keys:
        return NOTEBOOK
    if "$schema" in keys and keys & {"properties", "$defs"}:
        return SCHEMA
    return artefact.kind_by_keys(root)


def next_step(kind: str, path: Path) -> str:
    """Return what may be done with a file of a kind."""
    text = OTHERS[kind] if kind in OTHERS else artefact.of_kind(kind).next_step
    return text.format(file=as_typed(path))


def kind_of(path: Path) -> str | None:
    """The kind of a file by its form, or of a YAML or JSON file by its keys; None where neither says."""
    if (kind := kind_by_form(path)) is not None or path.suffix.lower() not in WRITTEN:
        return kind
    return _by_keys(path)


def _by_keys(path: Path) -> str | None:
    try:
        return kind_by_keys(YamlFile(path).root)
    except InputError:
        return None


def refuse_other(path: Path, kind: str | None, *wanted: str) -> None:
    """InputError where a file is of another kind than is wanted, with the command that reads it."""
    if kind is not None and kind not in wanted and AS.get(kind) not in wanted and path.is_file():
        message = f"is {kind}, not {' or '.join(wanted)}: {next_step(kind, path)}"
        raise InputError([Fault(path, 0, 0, message)])


def refuse_unreadable(path: Path, *wanted: str) -> None:
    """InputError where what is given is missing, a folder, no file, or empty."""
    what = " or ".join(wanted)
    try:
        if path.is_dir():
            refuse_folder(path, what)
            raise InputError([Fault(path, 0, 0, _folder(path, what))])
        if not path.exists():
            raise InputError([Fault(path, 0, 0, f"no such file; give {what}")])
        if not path.is_file():
            raise InputError([Fault(path, 0, 0, "is no file")])  # a pipe would be waited for
        if not path.stat().st_size:
            raise InputError([Fault(path, 0, 0, f"is empty; give {what}")])
    except (OSError, ValueError):  # a name too long, a loop of links, a folder that may not be looked into
        raise InputError([Fault(path, 0, 0, f"no such file, or none that can be read; give {what}")]) from None


def check_form(path: Path, *wanted: str) -> None:
    """InputError where what is given is missing, a folder, empty, or by its form of another kind than is wanted."""
    refuse_unreadable(path, *wanted)
    refuse_other(path, kind_by_form(path), *wanted)


def check_given(path: Path, *wanted: str) -> None:
    """InputError where what is given is missing, a folder, empty, or a file of another kind than is wanted."""
    refuse_unreadable(path, *wanted)
    refuse_other(path, kind_of(path), *wanted)


def as_typed(path: Path) -> str:
    """A path as one types it in a shell."""
    return shlex.quote(str(path))


def refuse_folder(path: Path, what: str) -> None:
    """InputError where a folder is one that a command left, and not what is wanted."""
    if (left := artefact.left_in(path)) is not None:
        message = f"is {left.folder}, not {what}: {left.folder_step.format(file=as_typed(path))}"
        raise InputError([Fault(path, 0, 0, message)])


def _folder(path: Path, what: str) -> str:
    """That a folder is not what is wanted; what in it may be meant."""
    endings: Mapping[str, set[str]] = {FMU: {".fmu"}, LOG: set(suffixes()), SSP: {".ssp"}, CODE: {".py"}}
    meant = {e for kind, those in endings.items() if kind in what for e in those} or {".yaml", ".yml"}
    inside = sorted(p.name for p in path.iterdir() if p.suffix.lower() in meant and p.is_file())
    some = f" {', '.join(inside[:3])}{', …' if inside[3:] else ''}" if inside else " none by its ending"
    return f"is a folder, not {what}; in it:{some}"
