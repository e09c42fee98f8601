"""Differences between two outcomes of a command: exit code, keys, numbers of tables; what is intended, what is not."""

from __future__ import annotations

import csv
import io
import json
import math
import re
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from tests.corpus.running import Outcome

# Keys of JSON and YAML whose values differ between two runs of one revision, or name the revision. A value below one of
# them is not compared.
VOLATILE = {
    "cosim_version": "version of the package",
    "guid": "of an FMU, a hash of what it was built from",
    "growth": "memory of a process",
    "runs_a_second": "inverse of a duration",
    "seconds": "duration",
    "timings": "durations",
    "version": "version of the package",
    "versions": "versions of packages and of the machine",
}
MOST_INTENDED = 30  # entries of an issue
NEXT_TO_ZERO = 1e-12  # where a tolerance is stated
HASH = re.compile(r"[0-9a-f]{64}")  # of an FMU, which has the sources of its revision, or of places
CLOCK_TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d")
TEXT_BLANKS = 3  # a text with so many blanks is a sentence: that it is there counts, not its wording
TABLE_VALUES = 8  # a list with more numbers is compared as a column
EXACT = 2**53  # integers beyond it are compared by their digits, as doubles do not tell them apart

Leaf = Any  # a number, a text, None, or a column: an array of numbers or a tuple of texts


@dataclass(frozen=True)
class Difference:
    """A key with two values; None for a key that is not there."""

    command: str
    key: str
    old: str | None
    new: str | None


@dataclass
class Intended:
    """An entry of `intended.yaml`, with the number of times that it was used."""

    commands: str
    because: str
    keys: Sequence[str] = ()
    instead: Mapping[str, str] = field(default_factory=dict)
    uses: int = 0

    def replaced(self, name: str, text: str) -> str:
        """Return a command line, or a file name, of the new side."""
        if fnmatchcase(name, self.commands):
            for old, new in self.instead.items():
                if old in text:
                    self.uses += 1
                    text = text.replace(old, new)
        return text

    def explains(self, difference: Difference) -> bool:
        """Return whether the entry is about a difference, and count it."""
        if not fnmatchcase(difference.command, self.commands):
            return False
        if not any(fnmatchcase(difference.key, pattern) for pattern in self.keys):
            return False
        self.uses += 1
        return True


def read_intended(path: Path) -> list[Intended]:
    """Return the entries of a file."""
    entries = [Intended(**entry) for entry in yaml.safe_load(path.read_text(encoding="utf-8")) or []]
    if len(entries) > MOST_INTENDED:
        raise SystemExit(f"{path.name}: {len(entries)} entries; an issue has at most {MOST_INTENDED}")
    if empty := [entry.commands for entry in entries if not entry.because.strip()]:
        raise SystemExit(f"{path.name}: `because` is empty: {', '.join(empty)}")
    return entries


def differences(
    name: str, old: Outcome, new: Outcome, tolerance: float = 0.0, intended: Sequence[Intended] = ()
) -> list[Difference]:
    """Return all differences of two outcomes of one command."""
    found = []
    if old.code != new.code:
        found.append(Difference(name, "exit code", f"{old.code}", f"{new.code}: {new.errors.strip()[-300:]}"))

    def renamed(file: str) -> str:
        for entry in intended:
            file = entry.replaced(name, file)
        return file

    olds, news = leaves(old, renamed), leaves(new)
    for key in sorted(olds.keys() | news.keys()):
        if key not in olds or key not in news:
            sides = [_shown(leaves_[key]) if key in leaves_ else None for leaves_ in (olds, news)]
            found.append(Difference(name, key, *sides))
        elif told := leaf_difference(olds[key], news[key], tolerance):
            found.append(Difference(name, key, *told))
    return _whole_files(found, olds, news)


def _whole_files(found: list[Difference], olds: Mapping[str, Leaf], news: Mapping[str, Leaf]) -> list[Difference]:
    """Tell of a file that is missing or new once, not once for each of its keys."""
    files = [{key.partition(":")[0] for key in side} for side in (olds, news)]
    kept = []
    for difference in found:
        file, colon, _ = difference.key.partition(":")
        if not colon or (file in files[0] and file in files[1]):
            kept.append(difference)
    return kept


def unexplained(found: Iterable[Difference], intended: Sequence[Intended]) -> list[Difference]:
    """Return the differences that no entry explains."""
    left = []
    for difference in found:
        explanations = [entry.explains(difference) for entry in intended]  # each one counts
        if not any(explanations):
            left.append(difference)
    return left


def leaves(outcome: Outcome, renamed: Callable[[str], str] = str) -> dict[str, Leaf]:
    """Return everything of an outcome but its exit code, by key: `printed:a.b`, `out/results.csv:plant.x`."""
    found: dict[str, Leaf] = {}
    if outcome.printed is not None:
        found["printed"] = "there"
        found |= {f"printed:{key}": leaf for key, leaf in flatten(outcome.printed).items()}
    found |= {f"{renamed(name)} removed": "removed" for name in outcome.removed}
    if outcome.files is not None:
        for path in sorted(path for path in outcome.files.rglob("*") if path.is_file()):
            name = renamed(path.relative_to(outcome.files).as_posix())
            found[name] = "there"
            found |= {f"{name}:{key}" if key else name: leaf for key, leaf in file_leaves(path, outcome.plain).items()}
    return found


def file_leaves(path: Path, plain: Callable[[str], str] = str) -> dict[str, Leaf]:
    """Return what a file says, by key; nothing of a kind that nobody reads by program."""
    try:
        match path.suffix:
            case ".csv":
                return _csv_columns(plain(path.read_text(encoding="utf-8")))
            case ".json":
                return flatten(json.loads(plain(path.read_text(encoding="utf-8"))))
            case ".yaml":
                return flatten(yaml.safe_load(plain(path.read_text(encoding="utf-8"))))
            case ".parquet":
                return _parquet_columns(path)
            case ".mat":
                return _mat_arrays(path)
            case ".h5" | ".hdf5":
                return _hdf5_arrays(path)
            case ".fmu" | ".ssp":
                with zipfile.ZipFile(path) as archive:
                    texts = {name: archive.read(name).decode() for name in archive.namelist()}
                return {f"{name}.{key}": leaf for name, text in texts.items() for key, leaf in _xml(text).items()}
            case ".ssv" | ".ssd" | ".xml":
                return _xml(path.read_text(encoding="utf-8"))
    except (ValueError, KeyError, OSError, yaml.YAMLError, zipfile.BadZipFile, ElementTree.ParseError) as error:
        return {"cannot be read": type(error).__name__}
    return {}


def flatten(value: Any, key: str = "") -> dict[str, Leaf]:
    """Return the leaves of JSON by their paths; values of volatile keys are left out, their keys are not."""
    if isinstance(value, dict):
        found: dict[str, Leaf] = {}
        for name, part in value.items():
            place = f"{key}.{name}" if key else f"{name}"
            found |= {place: "volatile"} if name in VOLATILE else flatten(part, place)
        return found or {key: "{}"}
    if isinstance(value, list):
        if len(value) > TABLE_VALUES and all(_is_number(v) and not _is_long(v) for v in value):
            return {key: np.array(value, dtype=float)}
        return {k: v for i, part in enumerate(value) for k, v in flatten(part, f"{key}.{i}").items()} or {key: "[]"}
    return {key: value}


def leaf_difference(old: Leaf, new: Leaf, tolerance: float) -> tuple[str, str] | None:
    """Return both values as text where they differ."""
    if isinstance(old, np.ndarray) and isinstance(new, np.ndarray):
        return _column_difference(old, new, tolerance)
    if _is_number(old) and _is_number(new):
        near = math.isclose(old, new, rel_tol=tolerance, abs_tol=NEXT_TO_ZERO if tolerance else 0.0)
        equal = near or (math.isnan(old) and math.isnan(new))
    elif isinstance(old, str) and isinstance(new, str) and _kind(old) and _kind(old) == _kind(new):
        equal = True
    else:
        equal = type(old) is type(new) and not isinstance(old, np.ndarray) and old == new
    return None if equal else (_shown(old), _shown(new))


def _column_difference(old: np.ndarray, new: np.ndarray, tolerance: float) -> tuple[str, str] | None:
    if old.shape != new.shape:
        return f"{old.shape} values", f"{new.shape} values"
    size = np.abs(old[np.isfinite(old)]).max(initial=0.0)
    with np.errstate(invalid="ignore"):
        apart = np.abs(new - old)
        equal = (new == old) | (np.isnan(new) & np.isnan(old)) | (apart <= tolerance * size)
    if equal.all():
        return None
    apart = np.where(equal, 0.0, np.where(np.isnan(apart), np.inf, apart))
    place = np.unravel_index(int(apart.argmax()), apart.shape)
    count = int((~equal).sum())
    return f"{old[place]}", f"{new[place]} ({count} of {old.size} values differ, most at {place})"


def _is_number(value: Leaf) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_long(value: float) -> bool:
    return isinstance(value, int) and abs(value) > EXACT


def _kind(text: str) -> str:
    """Return the kind of a text whose wording does not count."""
    if HASH.fullmatch(text):
        return "hash"
    if CLOCK_TIME.match(text):
        return "time of the day"
    return "sentence" if text.count(" ") >= TEXT_BLANKS else ""


def _shown(leaf: Leaf) -> str:
    if isinstance(leaf, np.ndarray):
        return f"{leaf.size} values"
    text = json.dumps(leaf, ensure_ascii=False, default=str)
    return text if len(text) <= 100 else f"{text[:97]}..."


# -- kinds of files -------------------------------------------------------------------------------------------


def _csv_columns(text: str) -> dict[str, Leaf]:
    rows = list(csv.reader(io.StringIO(text)))
    if not rows:
        return {}
    head, *rows = rows
    if any(len(row) != len(head) for row in rows):
        return {"cells": tuple(tuple(row) for row in rows)}
    columns = zip(*rows, strict=True) if rows else ((),) * len(head)
    return {name or f"column {k}": _column(cells) for k, (name, cells) in enumerate(zip(head, columns, strict=True))}


def _column(cells: Sequence[str]) -> Leaf:
    if any(cell.lstrip("-").isdecimal() and _is_long(int(cell)) for cell in cells):
        return tuple(cells)
    try:
        return np.array([float(cell) if cell else math.nan for cell in cells])
    except ValueError:
        return tuple(cells)


def _array(values: Any) -> Leaf:
    array = np.asarray(values)
    return array.astype(float) if array.dtype.kind in "biuf" else tuple(str(value) for value in array.ravel())


def _parquet_columns(path: Path) -> dict[str, Leaf]:
    from pyarrow import parquet

    table = parquet.read_table(path)
    return {name: _array(table[name].to_pylist()) for name in table.column_names}


def _mat_arrays(path: Path) -> dict[str, Leaf]:
    from scipy.io import loadmat

    return {name: _array(values) for name, values in loadmat(path).items() if not name.startswith("__")}


def _hdf5_arrays(path: Path) -> dict[str, Leaf]:
    import h5py

    found: dict[str, Leaf] = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: _array(item[()])} if hasattr(item, "shape") else {}))
    return found


def _xml(text: str) -> dict[str, Leaf]:
    """Return attributes and texts of all elements; an element with a name is found by it, another one by its number."""
    found: dict[str, Leaf] = {}

    def visit(element: ElementTree.Element, key: str) -> None:
        for name, value in element.attrib.items():
            if name not in {"guid", "instantiationToken", "generationDateAndTime", "generationTool"}:
                found[f"{key}@{name.rpartition('}')[2]}"] = _cell(value)
        if element.text and element.text.strip():
            found[key] = _cell(element.text.strip())
        numbers: dict[str, int] = {}
        for child in element:
            tag = child.tag.rpartition("}")[2]
            numbers[tag] = numbers.get(tag, -1) + 1
            visit(child, f"{key}.{tag}.{child.get('name', numbers[tag])}")

    visit(ElementTree.fromstring(text), "")
    return found


def _cell(text: str) -> Leaf:
    try:
        return float(text)
    except ValueError:
        return text
