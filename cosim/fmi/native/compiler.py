"""The C compiler of this machine, and the libraries it has made."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shlex
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.base.drafts import draft_of
from cosim.base.scratch import temporary_folder
from cosim.storage.cache import cached, discard_untrusted

OPTIONS = ("-O3", "-fno-math-errno", "-shared", "-fPIC", "-std=c99")  # errno of sin and pow is not looked at
LIMIT = 900.0  # [s] that a compiler may take
PLAIN, PACKED = (b"\x7fELF", b"MZ"), (b"\xcf\xfa\xed\xfe", b"\xca\xfe\xba\xbe")  # Linux, Windows; macOS


def compiler() -> list[str] | None:
    """The command of the C compiler: what `CC` in the environment says, else cc, gcc or clang; None: there is none."""
    named = os.environ.get("CC")
    commands = (_words(c) for c in (("cc", "gcc", "clang") if named is None else (named,)))
    return next((words for words in commands if words and shutil.which(words[0])), None)


def _words(command: str) -> list[str]:
    """A command as a shell splits it; none where a quote is left open."""
    try:
        return shlex.split(command)
    except ValueError:
        return []


class CompilerFailed(RuntimeError):
    """What the compiler said, in a line; `output` holds all of it."""

    def __init__(self, reason: str, output: str = "") -> None:
        super().__init__(reason)
        self.output = output


def library_of(
    files: Mapping[str, bytes],
    main: str,
    command: Sequence[str],
    exports: Sequence[str] = (),
    *,
    libraries: Sequence[str] = ("-lm",),
    limit: float = LIMIT,
) -> bytes:
    """The shared library of sources, from the cache or compiled now; CompilerFailed with what the compiler said.

    files:   by their path below the folder in which the compiler runs
    exports: functions that it is looked at for: some commands end without an error and make something else
    limit:   of the compiler's time [s]
    """
    content = hashlib.sha256(repr((sorted(files.items()), main, list(command), *libraries)).encode()).hexdigest()
    stem = cached(content, "")
    for kept in _kept(stem):
        if kept == _named(stem, kept) and not _missing(kept.read_bytes(), exports):
            return kept.read_bytes()
        kept.unlink(missing_ok=True)
    with temporary_folder("compile") as folder:
        for file, data in files.items():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_bytes(data)
        library = _compile([*command, "-o", "library", main, *libraries], folder, limit)
        if missing := _missing(library.read_bytes(), exports):
            told = f"it ended without an error, but what it made is no library that has {missing[0]}"
            raise CompilerFailed(f"{shlex.join(command[:1])} failed: {told}")
        return _keep(library, stem).read_bytes()


def _compile(command: Sequence[str], folder: Path, limit: float) -> Path:
    """The `library` that a command makes in a folder, so that no path of this machine gets into it."""
    options: dict[str, Any] = {"capture_output": True, "text": True, "errors": "replace", "timeout": limit}
    try:
        done = subprocess.run(command, cwd=folder, stdin=subprocess.DEVNULL, **options)
    except subprocess.TimeoutExpired:
        raise CompilerFailed(f"{command[0]} was not done in {limit:g} s") from None
    except OSError as error:
        raise CompilerFailed(f"{command[0]}: {error}") from error
    library = folder / "library"
    if done.returncode or not library.is_file():
        output = (done.stderr or done.stdout).strip()
        said = output.splitlines()
        first = next((line for line in said if "error" in line.lower()), said[-1] if said else "it says nothing")
        if done.returncode == 0:
            first = f"it ended without an error and made no library{f'; it said {first}' if said else ''}"
        raise CompilerFailed(f"{shlex.join(command[:1])} failed: {first}", output)
    return library


def _missing(library: bytes, exports: Sequence[str]) -> list[str]:
    """Functions that a library does not name; all of them where it is none."""
    if library.startswith(PACKED):  # names in a tree of their parts
        return []
    return [name for name in exports if not library.startswith(PLAIN) or name.encode() + b"\0" not in library]


def loaded(source: str) -> ctypes.CDLL:
    """The shared library of a source; one of another machine in the cache is compiled anew."""
    library = _compiled(source)
    try:
        return ctypes.CDLL(str(library))
    except OSError:
        library.unlink(missing_ok=True)
        return ctypes.CDLL(str(_compiled(source)))


def _compiled(source: str) -> Path:
    """The shared library of a source, from the cache or compiled now.

    Its name ends with the hash of its content: to load one that is damaged can end the process.
    """
    stem = cached(source, "")
    for kept in _kept(stem):
        if kept.name == _named(stem, kept).name:
            return kept
        kept.unlink(missing_ok=True)
    command = compiler()
    if command is None:
        raise FileNotFoundError("no C compiler")
    with temporary_folder("compile") as folder:
        file, library = folder / "model.c", folder / "model.so"
        file.write_text(source, encoding="utf-8")
        full = [*command, *OPTIONS, "-o", str(library), str(file), "-lm"]
        subprocess.run(full, check=True, capture_output=True, timeout=120)
        return _keep(library, stem)


def _kept(stem: Path) -> list[Path]:
    """Return the libraries of a source in the cache that this user alone can have written."""
    found = list(stem.parent.glob(f"{stem.name}-*.so"))
    return [path for path in found if discard_untrusted([path]) and path.exists()]


def _keep(library: Path, stem: Path) -> Path:
    """Copy a library into the cache, whole or not at all."""
    path = _named(stem, library)
    with draft_of(path) as draft:
        shutil.copyfile(library, draft)
    return path


def _named(stem: Path, library: Path) -> Path:
    """Where a library of this content is kept."""
    return stem.with_name(f"{stem.name}-{hashlib.sha256(library.read_bytes()).hexdigest()[:32]}.so")
