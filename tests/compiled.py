"""FMUs of C for the tests, whose libraries are compiled once a process."""

from __future__ import annotations

import platform
import re
import subprocess
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import pytest

from cosim.fmi.native.compiler import compiler
from tests.corpus.inputs import FMU_SOURCES


@cache
def library(source: Path, *options: str) -> Path:
    """Return the library of a file of C, compiled for this machine; skip the test without a compiler."""
    command = compiler()
    if command is None or platform.system() != "Linux" or platform.machine() != "x86_64":
        pytest.skip("no C compiler for this platform")
    made = Path(tempfile.mkdtemp(prefix=f"{source.stem}-")) / f"{source.stem}.so"
    flags = ["-O1", "-w", "-shared", "-fPIC", *options]
    subprocess.run([*command, *flags, "-o", str(made), str(source), "-lm"], check=True)
    return made


@cache
def description(name: str) -> str:
    """Return the description of an FMU of the corpus."""
    return (FMU_SOURCES / f"{name}.xml").read_text(encoding="utf-8")


def rewritten(source: Path, target: Path, change: Callable[[str, bytes], bytes]) -> Path:
    """Write an archive of which each member is changed by its name and content."""
    with zipfile.ZipFile(source) as archive:
        members = {name: change(name, archive.read(name)) for name in archive.namelist()}
    with zipfile.ZipFile(target, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return target


def pack(path: Path, text: str, binary: Path | None, members: Mapping[str, str | bytes] | None = None) -> Path:
    """Write an FMU of a description, its library for Linux and further members."""
    path.parent.mkdir(exist_ok=True)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", text)
        if binary is not None:
            folder = "x86_64-linux" if 'fmiVersion="3' in text else "linux64"
            (name,) = set(re.findall(r'modelIdentifier="(\w+)"', text))
            archive.write(binary, f"binaries/{folder}/{name}.so")
        for name, content in (members or {}).items():
            archive.writestr(name, content)
    return path
