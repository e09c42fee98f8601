"""Recordings of others, which are not part of this project: from a folder, or from their public home into it.

`write_rows`, `write_study` and `run_make_logs` are what the scripts that cut them into logs have in common.

Whatever its origin, a file is used only if its SHA-256 is the one that is written beside its address.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import sys
import urllib.error
import urllib.request
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

TIMEOUT = 60.0  # [s]


@dataclass(frozen=True)
class Recording:
    """A file: its name in a folder, its public home, the SHA-256 of its content.

    copies: further names under which a folder may hold the same numbers in other bytes, and the SHA-256 of these.
    """

    name: str
    url: str
    sha256: str
    copies: Mapping[str, str] = field(default_factory=dict)


class RecordingError(Exception):
    """A recording is out of reach, or not the one that is meant."""


def recorded(recording: Recording, folder: Path) -> Path:
    """Return the recording in `folder`, after a download if missing.

    Raises:
        RecordingError: The download failed, or the file is a different one.
    """
    for name, sha256 in {recording.name: recording.sha256, **recording.copies}.items():
        path = folder / name
        if path.is_file():
            _check(name, sha256, path.read_bytes(), str(path))
            return path
    content = _downloaded(recording, folder)
    _check(recording.name, recording.sha256, content, recording.url)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / recording.name
    path.write_bytes(content)
    return path


def _downloaded(recording: Recording, folder: Path) -> bytes:
    try:
        with urllib.request.urlopen(recording.url, timeout=TIMEOUT) as answer:
            return bytes(answer.read())
    except (urllib.error.URLError, OSError) as error:
        reason = getattr(error, "reason", None) or error
        raise RecordingError(
            f"{recording.name} is not in {folder} and cannot be downloaded ({reason}).\n"
            f"Without a network: put the file of {recording.url} there, by that name, and run this again."
        ) from None


def _check(name: str, sha256: str, content: bytes, origin: str) -> None:
    found = hashlib.sha256(content).hexdigest()
    if found != sha256:
        raise RecordingError(
            f"{origin} is not the recording that this example is about: its SHA-256 is {found},\n"
            f"that of {name} is {sha256}."
        )


def write_rows(path: Path, header: str, rows: Iterable[str]) -> None:
    """Write a CSV."""
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")


def write_study(
    folder: Path,
    model: Path,
    kind: str = "",
    keys: str = "",
    *,
    estimation: Sequence[str] = ("e1.csv", "e2.csv"),
    validation: Sequence[str] = ("v1.csv",),
    name: str = "study.yaml",
) -> Path:
    """Write a study of logs in a folder, those for validation sealed; return its path.

    Args:
        model: File of the model, or an FMU.
        kind: Class of the model in this file.
        keys: Further lines of the study.
    """
    path = folder / name
    place = Path(os.path.relpath(model, folder.resolve())).as_posix()
    logs = f"logs:\n  estimation: [{', '.join(estimation)}]\n  validation: [{', '.join(validation)}]\n"
    path.write_text(f"model: {place}{kind and ':'}{kind}\n{keys}{logs}", encoding="utf-8")
    return path


def run_make_logs(
    make_logs: Callable[[Path, Path], Path | list[Path]],
    description: str | None,
    write_fmu_study: Callable[[Path], Path] | None = None,
) -> int:
    """Write logs and study to the folders of the command line; return the exit code.

    Args:
        write_fmu_study: What `--fmu` writes, too.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("data", type=Path, help="folder of the recordings; missing ones are downloaded into it")
    parser.add_argument("out", type=Path, help="folder for the logs and the study")
    if write_fmu_study is not None:
        parser.add_argument("--fmu", action="store_true", help="write the FMU and its study, too")
    options = parser.parse_args()
    try:
        studies = make_logs(options.data, options.out)
        print(*(studies if isinstance(studies, list) else [studies]), sep="\n")
        if write_fmu_study is not None and options.fmu:
            print(write_fmu_study(options.out))
    except RecordingError as error:
        print(error, file=sys.stderr)
        return 2
    return 0
