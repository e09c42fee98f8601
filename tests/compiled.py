"""Libraries of C for FMUs of the tests, compiled once a process."""

from __future__ import annotations

import platform
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import pytest

from cosim.fmi.native.compiler import compiler


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
