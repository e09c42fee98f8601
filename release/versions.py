"""Try other versions: of Python, and the oldest and newest allowed ones of every dependency.

`resolve` finds a complete set of wheels for each version of Python and platform, without installing. `run` makes an
environment and runs tests in it: with the oldest allowed dependencies, and with every Python that is here.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from release.dist import ROOT, program

PYTHONS = ("3.11", "3.12", "3.13", "3.14")
PLATFORMS = ("x86_64-manylinux_2_28", "aarch64-manylinux_2_28", "x86_64-pc-windows-msvc", "aarch64-apple-darwin")
EXTRAS = ("refine", "sweep", "hdf5")
TEST_TOOLS = (
    "pytest>=8",
    "pytest-xdist>=3.7",
    "hypothesis>=6.100",
    "jsonschema>=4.18",
    "nbclient",
    "ipykernel",
    "grimp",
)
TESTS = tuple(  # each dependency is used by one of these
    f"tests/test_{name}.py"
    for name in (
        *("units", "scenario", "run", "formats", "loading", "report", "linearize", "sweep", "ssp", "exchange", "cli"),
        *("lqr", "kalman", "notebook", "fit"),
    )
)


def uv(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run uv beside this Python."""
    return subprocess.run([program("uv"), *arguments], cwd=ROOT, capture_output=True, text=True)


def resolve() -> int:
    """Print the number of wheels for each Python and platform; return 1 if a set is not complete."""
    failed = 0
    words = [word for extra in EXTRAS for word in ("--extra", extra)]
    for python in PYTHONS:
        for platform in PLATFORMS:
            where = ("--python-version", python, "--python-platform", platform, "--only-binary", ":all:")
            done = uv("pip", "compile", "--quiet", "pyproject.toml", *words, *where)
            failed += bool(done.returncode)
            count = sum("==" in line for line in done.stdout.splitlines())
            print(f"Python {python}  {platform}: {done.stderr.strip() or f'{count} wheels'}", flush=True)
    return int(failed > 0)


def run(version: str, resolution: str, tests: Sequence[str]) -> int:
    """Run tests in a new environment; return the exit code of pytest, 0 without such a Python.

    Args:
        version: Version of Python, "3.12".
        resolution: `highest` for the newest allowed dependencies, `lowest-direct` for the oldest ones.
        tests: Files of tests.
    """
    name = f"Python {version}, {'oldest' if resolution == 'lowest-direct' else 'newest'} dependencies"
    projects = ("--editable", f".[{','.join(e for e in EXTRAS if e != 'refine')}]", "--editable", "examples/hovercraft")
    with tempfile.TemporaryDirectory() as folder:
        made = uv("venv", "--no-python-downloads", "--python", version, folder)
        if made.returncode:
            print(f"{name}: not here: {made.stderr.strip()}")
            return 0
        place = ("--python", str(Path(folder) / "bin" / "python"), "--resolution", resolution)
        wheels = ("--only-binary", ":all:", "--no-binary", "fmu-cosim", "--no-binary", "fmu-cosim-hovercraft")
        # tools of the tests first, so that their own oldest versions are not taken
        for words in (TEST_TOOLS, (*wheels, *place[2:], *projects)):
            made = made if made.returncode else uv("pip", "install", *place[:2], *words)
        if made.returncode:
            print(f"{name}: {made.stderr.strip()}")
            return 1
        print(f"{name}:", flush=True)
        command = [str(Path(folder) / "bin" / "python"), "-m", "pytest", "-n", "0", "-m", "not thorough", *tests]
        # warnings of versions that are not the ones of `make test` are no faults of this package
        options = ("-o", "filterwarnings=default", "--disable-warnings", "-p", "no:cacheprovider")
        return subprocess.run([*command, *options], cwd=ROOT).returncode


def main(arguments: Sequence[str] | None = None) -> int:
    """Resolve wheels, or run tests with other versions."""
    parser = argparse.ArgumentParser(description="Try other versions of Python and of the dependencies.")
    parser.add_argument("what", choices=["resolve", "run"])
    parser.add_argument("--python", nargs="*", default=list(PYTHONS), help="versions (default: all)")
    parser.add_argument("--oldest", action="store_true", help="the oldest allowed dependencies, with the first version")
    parser.add_argument("--tests", nargs="*", default=list(TESTS), help="files of tests")
    chosen = parser.parse_args(arguments)
    if chosen.what == "resolve":
        return resolve()
    if chosen.oldest:
        return run(chosen.python[0], "lowest-direct", chosen.tests)
    return max(run(version, "highest", chosen.tests) for version in chosen.python)


if __name__ == "__main__":
    sys.exit(main())
