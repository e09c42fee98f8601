"""Build a wheel and an sdist of both distributions into dist/; a commit gives wheels of the same bytes.

Each distribution is built from copies of its tracked files. What an earlier build left in the checkout cannot get into
a wheel, and the sdist of the example, whose packages are elsewhere in the checkout, is complete.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DIST = ROOT / "dist"
OUTSIDE = "package-dir"  # key of the example's pyproject.toml: its packages are elsewhere in the checkout
TEXTS = ("README.md", "LICENSE", "CHANGELOG.md")
CORE: Mapping[str, str] = {p: p for p in ("cosim", "pyproject.toml", "MANIFEST.in", *TEXTS)}
EXAMPLE: Mapping[str, str] = {
    **{p: p for p in ("plant", "controller", "fmus", "LICENSE")},
    "examples/hovercraft/pyproject.toml": "pyproject.toml",
}


def tracked(part: str) -> Iterator[Path]:
    """Yield the files of a part of the checkout that git does not ignore, relative to the checkout."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z", "--", part]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    yield from (
        path for name in sorted(filter(None, done.stdout.split("\0"))) if (ROOT / (path := Path(name))).is_file()
    )


def stage(parts: Mapping[str, str], folder: Path) -> Path:
    """Copy parts of the checkout to their places in a folder; drop the key that leads out of it."""
    for part, place in parts.items():
        for path in tracked(part):
            target = folder / place / path.relative_to(part)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / path, target)
    project = folder / "pyproject.toml"
    lines = project.read_text(encoding="utf-8").splitlines(keepends=True)
    project.write_text("".join(line for line in lines if not line.startswith(OUTSIDE)), encoding="utf-8")
    return folder


def build(out: Path) -> list[Path]:
    """Build the wheels and sdists of both distributions into a folder; return their paths.

    Raises:
        CalledProcessError: The folder is no checkout.
        SystemExit: A build failed.
    """
    head = subprocess.run(["git", "log", "-1", "--format=%ct"], cwd=ROOT, capture_output=True, text=True, check=True)
    environment = {**os.environ, "SOURCE_DATE_EPOCH": head.stdout.strip(), "PYTHONWARNINGS": "ignore"}
    with tempfile.TemporaryDirectory() as name:
        for number, parts in enumerate((CORE, EXAMPLE)):
            source = stage(parts, Path(name) / str(number))
            command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(source)]
            done = subprocess.run(command, env=environment, capture_output=True, text=True)
            if done.returncode:
                sys.exit(done.stdout + done.stderr)
    return sorted(path for path in out.iterdir() if path.suffix in {".whl", ".gz"})


def program(name: str) -> str:
    """Return the path of a program beside this Python, or its name."""
    path = Path(sys.executable).with_name(name)
    return str(path) if path.is_file() else name


def main() -> int:
    """Build into dist/, without distributions of earlier builds."""
    for old in (*DIST.glob("fmu_cosim*.whl"), *DIST.glob("fmu_cosim*.tar.gz")):
        old.unlink()
    for path in build(DIST):
        print(f"{path.relative_to(ROOT)}  {path.stat().st_size / 1e6:.2f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
