"""Commands of a second user of the machine, for tests of what two users share."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import ROOT

OTHER = 54321  # a user that is in no list of the machine
PYTHONS = (sys.executable, *(f"{place}/python3.{sys.version_info.minor}" for place in ("/usr/bin", "/usr/local/bin")))
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}  # of a command
PATH = os.pathsep.join([str(ROOT), *(entry for entry in sys.path if entry.endswith("site-packages"))])


def other_user(**environment: str) -> dict[str, Any]:
    """Return the arguments of `cosim` for a command of a second user; skip if impossible."""
    if os.name == "nt" or os.geteuid() != 0:
        pytest.skip("only root can act as another user")
    own = {"PATH": os.environ["PATH"], "PYTHONPATH": PATH, **environment}
    given: dict[str, Any] = {"user": OTHER, "group": OTHER, "extra_groups": [], "env": own, "cwd": "/"}
    for python in PYTHONS:  # one may lie in a folder of root's own
        with suppress(OSError):
            command = [python, "-c", "import cosim.verbs.cli"]
            if not subprocess.run(command, capture_output=True, check=False, **given).returncode:
                return {**given, "python": python}
    pytest.skip("another user may not read this installation")


@contextmanager
def shared_folder() -> Iterator[Path]:
    """Make a folder like /tmp: every user may make files and only remove own files."""
    made = Path(tempfile.mkdtemp(dir="/tmp", prefix="shared-"))
    try:
        made.chmod(0o1777)
        yield made
    finally:
        shutil.rmtree(made, ignore_errors=True)


def command(*arguments: object, python: str = sys.executable) -> list[str]:
    """Return the words of a command."""
    return [python, "-m", "cosim", *map(str, arguments)]


def cosim(
    *arguments: object, python: str = sys.executable, timeout: float = 300.0, **given: Any
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end."""
    words = command(*arguments, python=python)
    return subprocess.run(words, capture_output=True, text=True, check=False, timeout=timeout, **given)
