"""Source tree, wheels and environment of a revision, and of the working tree."""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
import tarfile
import zipfile
from dataclasses import dataclass
from email import message_from_bytes
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PLACE = ROOT / "build" / "corpus"
EXTRAS = "hdf5,mcap,parquet,sweep"  # pip only warns of an extra that a revision lacks
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "-qq")


@dataclass(frozen=True)
class Side:
    """A revision, or the working tree, with the folder of its tree, environment and outcomes."""

    name: str
    folder: Path

    @property
    def tree(self) -> Path:
        """Folder of the sources."""
        return self.folder / "tree"

    @property
    def programs(self) -> Path:
        """Folder of the installed commands."""
        return self.folder / "env" / "bin"


def git(*words: str) -> bytes:
    """Return the output of a git command in this project."""
    return subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True).stdout


def revision(name: str = "revision") -> str:
    """Return the commit that the file `revision` states under a name."""
    lines = (Path(__file__).parent / "revision").read_text(encoding="utf-8").splitlines()
    return dict(line.split(": ") for line in lines)[name]


def revision_side(name: str) -> Side:
    """Install a revision once, and return its side."""
    try:
        commit = git("rev-parse", "--verify", f"{name}^{{commit}}").decode().strip()
    except subprocess.CalledProcessError:
        raise SystemExit(f"{name} is no revision of this clone; a shallow one needs git fetch --unshallow") from None
    side = Side(commit[:8], PLACE / commit)
    if not (side.folder / "installed").is_file():
        shutil.rmtree(side.folder, ignore_errors=True)
        with tarfile.open(fileobj=io.BytesIO(git("archive", commit))) as archive:
            archive.extractall(side.tree, filter="data")
        install(side)
        (side.folder / "installed").touch()
    return side


def working_side() -> Side:
    """Install the working tree, with uncommitted files, and return its side."""
    side = Side("this tree", PLACE / "this")
    for place in (side.tree, side.folder / "home"):
        shutil.rmtree(place, ignore_errors=True)
    for name in git("ls-files", "--cached", "--others", "--exclude-standard", "-z").decode().split("\0"):
        if name and (ROOT / name).is_file():
            (side.tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, side.tree / name)
    install(side)
    return side


def install(side: Side) -> None:
    """Build the wheels of both distributions, and install them with their requirements.

    An environment whose wheels require other packages than the one before is made anew, so that a requirement which a
    revision has dropped is not there by accident.
    """
    wheels = side.folder / "wheels"
    shutil.rmtree(wheels, ignore_errors=True)
    sources = [str(side.tree), str(side.tree / "examples" / "hovercraft")]
    subprocess.run([*PIP, "wheel", "--no-deps", "--no-build-isolation", "-w", str(wheels), *sources], check=True)
    for left in (side.tree / "build", *side.tree.rglob("*.egg-info")):
        shutil.rmtree(left, ignore_errors=True)
    paths = sorted(wheels.glob("*.whl"))
    wanted, state = "\n".join(line for path in paths for line in requirements(path)), side.folder / "requirements.txt"
    environment = side.folder / "env"
    if not state.is_file() or state.read_text(encoding="utf-8") != wanted:
        shutil.rmtree(environment, ignore_errors=True)
        subprocess.run([sys.executable, "-m", "venv", str(environment)], check=True)
    with_extras = [f"{path}[{EXTRAS}]" if path.name.startswith("fmu_cosim-") else str(path) for path in paths]
    pip = [*PIP, "--python", str(environment / "bin" / "python"), "install"]
    subprocess.run([*pip, *with_extras], check=True)
    subprocess.run([*pip, "--force-reinstall", "--no-deps", *map(str, paths)], check=True)
    state.write_text(wanted, encoding="utf-8")


def requirements(wheel: Path) -> list[str]:
    """Return the requirements of a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        return sorted(message_from_bytes(archive.read(name)).get_all("Requires-Dist", []))
