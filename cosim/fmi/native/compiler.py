"""C compilers of this machine or from pip, and their libraries."""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.base.drafts import draft_of
from cosim.base.extras import install_command
from cosim.base.scratch import temporary_folder
from cosim.fmi.native.platforms import PLATFORMS, Platform, here
from cosim.storage.cache import cache_environment, cached, discard_untrusted

# The errno of sin and pow is never read.
OPTIONS = ("-std=c99", "-O3", "-fno-math-errno", "-ffp-contract=off", "-shared")
LIMIT = 900.0  # time limit of the compiler [s]
ZIG = "ziglang"  # C compiler for every platform, on PyPI
# library headers with plain names: Linux, Windows; with packed names: macOS
PLAIN, PACKED = (b"\x7fELF", b"MZ"), (b"\xcf\xfa\xed\xfe", b"\xca\xfe\xba\xbe")


class NoCompiler(LookupError):
    """A missing compiler for a platform, with the remedy."""


def compiler() -> list[str] | None:
    """Return the C compiler's command, if any."""
    return next(iter(compilers()), None)


def compilers() -> list[list[str]]:
    """Return the C compilers' commands, the best first.

    `CC` in the environment names a compiler; by default cc, gcc or clang is used. The extra `refine` installs another.
    """
    named = os.environ.get("CC")
    commands = (_words(c) for c in (("cc", "gcc", "clang") if named is None else (named,)))
    installed = next(([words] for words in commands if words and shutil.which(words[0])), [])
    own = here()
    return [*installed, *([crossing(own)] if own and can_cross() else [])]


def can_cross() -> bool:
    """Return whether a cross compiler is installed (extras `refine`, `native`)."""
    return importlib.util.find_spec(ZIG) is not None


def crossing(wanted: Platform) -> list[str]:
    """Return the cross compiler's command for a platform."""
    return [sys.executable, "-m", ZIG, "cc", "-target", wanted.target, "-s"]


def commands(asked: tuple[str, ...] = ()) -> dict[Platform, list[str]]:
    """Return platform → compiler command, by default for this machine.

    Raises:
        KeyError: A platform is unknown.
        NoCompiler: A compiler is missing.
    """
    own = here()
    if own is None and not asked:
        raise NoCompiler(f"this machine, {platform.machine()} {sys.platform}, is none of {', '.join(PLATFORMS)}")
    wanted = [PLATFORMS[name] for name in asked] or [p for p in PLATFORMS.values() if p == own]
    return {p: [*_for(p, p == own, bool(asked)), *OPTIONS, "-fvisibility=hidden", *p.position] for p in wanted}


def fmi_headers() -> Path:
    """Return FMPy's folder of FMI headers."""
    import fmpy

    return Path(fmpy.__file__).with_name("c-code")


def library_command() -> list[str]:
    """Return the command for a plain library of this machine; raise NoCompiler if none exists."""
    command = compiler()
    if command is None:
        raise NoCompiler(f"no C compiler is found; {cure('native')}")
    return [*command, "-shared", *_position()]


def cure(extra: str) -> str:
    """Return the remedy for a missing C compiler."""
    return f"install gcc or clang, say which in CC, or {install_command(extra)}"


def _for(wanted: Platform, own: bool, asked: bool) -> list[str]:
    """Return the local compiler, else the cross compiler. The cross compiler also targets old versions of glibc."""
    local = compiler() if own else None
    if can_cross() and (asked or local is None):
        return crossing(wanted)
    if local is not None:
        return local
    if own:
        raise NoCompiler(f"no C compiler is found; {cure('native')}")
    crosses = f"{install_command('native')}, which brings a compiler that crosses"
    raise NoCompiler(f"no compiler for {wanted.name} is found; {crosses}")


def _position() -> list[str]:
    own = here()
    return ["-fPIC"] if own is None else own.position


def _words(command: str) -> list[str]:
    """Return a command split as by a shell; none for an open quote."""
    try:
        return shlex.split(command)
    except ValueError:
        return []


class CompilerFailed(RuntimeError):
    """Failure of a compiler: its message in a line, all of it in `output`."""

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
    """Return a compiled shared library, possibly cached.

    Args:
        files: Contents by path below the compiler's folder.
        exports: Required functions, because some commands succeed without making the right library.
        limit: Time limit of the compiler [s].

    Raises:
        CompilerFailed: Compilation failed.
    """
    return _library(files, main, command, exports, libraries, limit).read_bytes()


def _library(
    files: Mapping[str, bytes],
    main: str,
    command: Sequence[str],
    exports: Sequence[str] = (),
    libraries: Sequence[str] = ("-lm",),
    limit: float = LIMIT,
) -> Path:
    """Return the cached path of a compiled library.

    Its name ends with a hash of the content, because a damaged library could crash.
    """
    content = hashlib.sha256(repr((sorted(files.items()), main, list(command), *libraries)).encode()).hexdigest()
    stem = cached(content, "")
    for kept in _find_cached(stem):
        if kept == _named(stem, kept) and not _missing(kept.read_bytes(), exports):
            return kept
        kept.unlink(missing_ok=True)
    with temporary_folder("compile") as folder:
        for file, data in files.items():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_bytes(data)
        library = _compile([*command, "-o", "library", main, *libraries], folder, limit)
        if missing := _missing(library.read_bytes(), exports):
            told = f"it ended without an error, but what it made is no library that has {missing[0]}"
            raise CompilerFailed(f"{shlex.join(command[:1])} failed: {told}")
        return _keep(library, stem)


def _compile(command: Sequence[str], folder: Path, limit: float) -> Path:
    """Compile a library in a folder, so that it contains no local path."""
    options: dict[str, Any] = {"capture_output": True, "text": True, "errors": "replace", "timeout": limit}
    options["env"] = {**os.environ, **cache_environment()}
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
    """Return required functions missing in a library."""
    if library.startswith(PACKED):  # names are stored as a tree of parts
        return []
    return [name for name in exports if not library.startswith(PLAIN) or name.encode() + b"\0" not in library]


def loaded(source: str, *headers: Path) -> ctypes.CDLL:
    """Return a loaded library compiled from source and headers.

    A cached library of another machine is compiled anew.

    Raises:
        NoCompiler: No compiler exists.
        CompilerFailed: All compilers fail.
    """
    files = {"model.c": source.encode(), **{path.name: path.read_bytes() for path in headers}}
    reason: Exception | None = None
    for command in compilers():
        full = [*command, *OPTIONS, *_position()]
        try:
            library = _library(files, "model.c", full)
            try:
                return ctypes.CDLL(str(library))
            except OSError:
                library.unlink(missing_ok=True)
                return ctypes.CDLL(str(_library(files, "model.c", full)))
        except (CompilerFailed, OSError) as error:
            reason = reason or error
    if reason is None:
        raise NoCompiler("no C compiler is found")
    raise CompilerFailed(str(reason)) from reason


def _find_cached(stem: Path) -> list[Path]:
    """Return the trusted cached libraries of a source."""
    found = list(stem.parent.glob(f"{stem.name}-*.so"))
    return [path for path in found if discard_untrusted([path]) and path.exists()]


def _keep(library: Path, stem: Path) -> Path:
    """Copy a library into the cache, completely or not at all."""
    path = _named(stem, library)
    with draft_of(path) as draft:
        shutil.copyfile(library, draft)
    return path


def _named(stem: Path, library: Path) -> Path:
    """Return the cache path for a library's content."""
    return stem.with_name(f"{stem.name}-{hashlib.sha256(library.read_bytes()).hexdigest()[:32]}.so")
