"""The commands of the corpus, run desk by desk: exit code, printed JSON and written files of each."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import zipfile
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.corpus.revisions import Side

TIMEOUT_S = 900.0  # some minutes on a machine that is busy
# Read by nobody: only their presence counts, and copies would be large.
PLACEHOLDERS = {".html", ".png", ".svg", ".pdf", ".so", ".mcap", ".npy", ".sqlite"}
ARCHIVES = {".fmu", ".ssp"}
DESCRIPTIONS = (".xml", ".ssd", ".ssv", ".ssm")  # members of an archive that are compared
NO_NETWORK = "http://127.0.0.1:9"  # a closed port in place of a proxy
HERE = Path(__file__).parent


@dataclass(frozen=True)
class Desk:
    """Commands that run one after the other in one folder."""

    name: str
    commands: tuple[str, ...]
    after: str = ""
    tolerance: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """Result of a command, with the folder of the files that it wrote or changed."""

    line: str
    code: int | str
    printed: Any
    removed: tuple[str, ...]
    files: Path | None
    plain: Callable[[str], str] = str  # replaces the folders of the side in a text
    errors: str = ""


def run_desks(
    side: Side, desks: Mapping[str, Desk], inputs: Path, jobs: ThreadPoolExecutor, *, reuse: bool
) -> dict[str, Future[list[Outcome]]]:
    """Start the desks of a side; with `reuse`, equal desks of an earlier run are read instead.

    A desk that starts from another one waits for it; the other one stands before it in the list, so it has begun.
    """
    running: dict[str, Future[list[Outcome]]] = {}
    for desk in desks.values():
        base = running[desk.after] if desk.after else None
        running[desk.name] = jobs.submit(_run_desk, side, desk, desks, inputs, base, reuse)
    return running


def key_of(desk: Desk, desks: Mapping[str, Desk], inputs: Path) -> str:
    """Return a hash of everything that determines the outcome of a desk for a given revision."""
    base = key_of(desks[desk.after], desks, inputs) if desk.after else ""
    code = hashlib.sha256((HERE / "running.py").read_bytes()).hexdigest()
    text = json.dumps([base, inputs.name, code, desk.commands])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _run_desk(
    side: Side, desk: Desk, desks: Mapping[str, Desk], inputs: Path, base: Future[list[Outcome]] | None, reuse: bool
) -> list[Outcome]:
    if base is not None:
        base.result()
    folder, kept = side.folder / "desks" / desk.name, side.folder / "outcomes" / desk.name
    key, state = key_of(desk, desks, inputs), kept / "key"
    if not (reuse and state.is_file() and state.read_text(encoding="utf-8") == key):
        for place in (folder, kept):
            shutil.rmtree(place, ignore_errors=True)
        _prepare(side, desk, folder, inputs)
        for number, line in enumerate(desk.commands):
            _run_command(side, line, folder, kept / f"{number:02}")
        state.write_text(key, encoding="utf-8")
    return [_read_outcome(kept / f"{number:02}", line) for number, line in enumerate(desk.commands)]


def _prepare(side: Side, desk: Desk, folder: Path, inputs: Path) -> None:
    """Copy scenarios and examples of the revision and the inputs of the corpus, or the whole desk before."""
    if desk.after:
        shutil.copytree(side.folder / "desks" / desk.after, folder, symlinks=True)
        return
    for name in ("scenarios", "examples"):
        shutil.copytree(side.tree / name, folder / name)
    shutil.copytree(inputs, folder / "inputs")


def environment(side: Side) -> dict[str, str]:
    """Return the environment variables of a command: no network, fixed seeds and dates, a home of its own."""
    home = side.folder / "home"
    (home / "tmp").mkdir(parents=True, exist_ok=True)
    proxies = dict.fromkeys(("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"), NO_NETWORK)
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return {
        "PATH": f"{side.programs}:{os.defpath}",
        "HOME": str(home),
        "TMPDIR": str(home / "tmp"),
        "LANG": "C.UTF-8",
        "COLUMNS": "120",
        "NO_COLOR": "1",
        "BROWSER": "true",
        "MPLBACKEND": "Agg",
        "SOURCE_DATE_EPOCH": "1700000000",
        "PYTHONHASHSEED": "0",
        **proxies,
        **threads,
    }


def _run_command(side: Side, line: str, folder: Path, kept: Path) -> None:
    kept.mkdir(parents=True)
    before = _snapshot(folder)
    code: int | str = "timeout"
    with (kept / "stdout").open("wb") as out, (kept / "stderr").open("wb") as errors:
        process = subprocess.Popen(
            shlex.split(line), cwd=folder, env=environment(side), start_new_session=True,
            stdin=subprocess.DEVNULL, stdout=out, stderr=errors,
        )  # fmt: skip
        try:
            code = process.wait(TIMEOUT_S)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    after = _snapshot(folder)
    for name in sorted(name for name, state in after.items() if before.get(name) != state):
        _keep(folder / name, kept / "files" / name)
    folders = [str(folder), str(side.tree), str(side.folder)]
    about = {"code": code, "removed": sorted(before.keys() - after.keys()), "folders": folders}
    (kept / "outcome.json").write_text(json.dumps(about), encoding="utf-8")


def _snapshot(folder: Path) -> dict[str, tuple[int, int]]:
    """Return time and size of each regular file; hidden ones and compiled Python are left out."""
    found = {}
    for place, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".") and name != "__pycache__"]
        for name in files:
            path = Path(place, name)
            if not name.startswith(".") and path.is_file() and not path.is_symlink():
                state = path.stat()
                found[path.relative_to(folder).as_posix()] = state.st_mtime_ns, state.st_size
    return found


def _keep(path: Path, copy: Path) -> None:
    """Copy what can be compared of a file: of an archive its descriptions, of a page that it is there."""
    copy.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix in PLACEHOLDERS:
        copy.touch()
    elif path.suffix in ARCHIVES and zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive, zipfile.ZipFile(copy, "w") as reduced:
            for name in archive.namelist():
                if name.endswith(DESCRIPTIONS):
                    reduced.writestr(name, archive.read(name))
    else:
        shutil.copyfile(path, copy)


def _read_outcome(kept: Path, line: str) -> Outcome:
    about = json.loads((kept / "outcome.json").read_text(encoding="utf-8"))
    pattern = re.compile("|".join(re.escape(folder) for folder in about["folders"]))
    names = dict(zip(about["folders"], ("DESK", "TREE", "SIDE"), strict=True))

    def plain(text: str) -> str:
        return pattern.sub(lambda match: names[match[0]], text)

    printed, errors = (
        plain((kept / name).read_text(encoding="utf-8", errors="replace")) for name in ("stdout", "stderr")
    )
    try:
        answer = json.loads(printed)
    except ValueError:
        answer = None
    return Outcome(line, about["code"], answer, tuple(about["removed"]), kept / "files", plain, errors[-2000:])
