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
from cosim.fmi.native.platforms import PLATFORMS, Platform, this_platform
from cosim.storage.cache import cache_environment, cache_path

# The errno of sin and pow is never read.
OPTIONS = ("-std=c99", "-O3", "-fno-math-errno", "-ffp-contract=off", "-shared")
LIMIT = 900.0  # time limit of the compiler [s]
ZIG = "ziglang"  # C compiler for every platform, on PyPI
# library headers with plain names: Linux, Windows; with packed names: macOS
PLAIN, PACKED = (b"\x7fELF", b"MZ"), (b"\xcf\xfa\xed\xfe", b"\xca\xfe\xba\xbe")


class NoCompiler(LookupError):
    """Error: no compiler for a platform exists; the message names the remedy."""


def compiler() -> list[str] | None:
    """Return the C compiler's command, if any."""
    return next(iter(compilers()), None)


def compilers() -> list[list[str]]:
    """Return the C compilers' commands, the best first.

    `CC` in the environment names a compiler; by default cc, gcc or clang is used. The extra `refine` installs another.
    """
    choice = os.environ.get("CC")
    commands = (_words(c) for c in (("cc", "gcc", "clang") if choice is None else (choice,)))
    installed = next(([words] for words in commands if words and shutil.which(words[0])), [])
    machine = this_platform()
    return [*installed, *([cross_command(machine)] if machine and can_cross() else [])]


def can_cross() -> bool:
    """Return whether a cross compiler is installed (extras `refine`, `native`)."""
    return importlib.util.find_spec(ZIG) is not None


def cross_command(target: Platform) -> list[str]:
    """Return the cross compiler's command for a platform."""
    return [sys.executable, "-m", ZIG, "cc", "-target", target.target, "-s"]


def commands(names: tuple[str, ...] = ()) -> dict[Platform, list[str]]:
    """Return platform → compiler command, by default for this machine.

    Raises:
        KeyError: A platform is unknown.
        NoCompiler: A compiler is missing.
    """
    machine = this_platform()
    if machine is None and not names:
        platforms = ", ".join(PLATFORMS)
        fault = f"this machine, {platform.machine()} {sys.platform}, is none of {platforms}; name one of these"
        raise NoCompiler(fault)
    targets = [PLATFORMS[name] for name in names] or [p for p in PLATFORMS.values() if p == machine]
    common = [*OPTIONS, "-fvisibility=hidden"]
    return {p: [*_command_for(p, p == machine, bool(names)), *common, *p.position] for p in targets}


def fmi_headers() -> Path:
    """Return FMPy's folder of FMI headers."""
    import fmpy

    return Path(fmpy.__file__).with_name("c-code")


def library_command() -> list[str]:
    """Return the command for a plain library of this machine; raise NoCompiler if none exists."""
    command = compiler()
    if command is None:
        raise NoCompiler(f"no C compiler is found in CC or on PATH; {cure('native')}")
    return [*command, "-shared", *_position()]


def cure(extra: str) -> str:
    """Return the remedy for a missing C compiler."""
    return f"install gcc or clang, say which in CC, or {install_command(extra)}"


def _command_for(target: Platform, is_local: bool, by_name: bool) -> list[str]:
    """Return the command of the compiler for a platform.

    The cross compiler, which also targets old versions of glibc, is taken for a platform named by the user, or without
    a local compiler.
    """
    local = compiler() if is_local else None
    if can_cross() and (by_name or local is None):
        return cross_command(target)
    if local is not None:
        return local
    if is_local:
        raise NoCompiler(f"no C compiler is found in CC or on PATH; {cure('native')}")
    raise NoCompiler(
        f"no compiler for {target.name} is found; {install_command('native')}, which brings a compiler that crosses"
    )


def _position() -> list[str]:
    machine = this_platform()
    return ["-fPIC"] if machine is None else machine.position


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
) -> Path:
    """Return the cached path of a compiled shared library.

    Its name ends with a hash of the content, because a damaged library could crash.

    Args:
        files: Contents by path below the compiler's folder.
        main: Path of the file to compile.
        command: Command of the compiler.
        exports: Required functions, because some commands succeed without making the right library.
        limit: Time limit of the compiler [s].

    Raises:
        CompilerFailed: Compilation failed.
    """
    content = hashlib.sha256(repr((sorted(files.items()), main, list(command), *libraries)).encode()).hexdigest()
    stem = cache_path(content, "")
    for library in stem.parent.glob(f"{stem.name}-*.so"):
        if library == _cache_path(stem, library) and not _missing_exports(library.read_bytes(), exports):
            return library
        library.unlink(missing_ok=True)
    with temporary_folder("compile") as folder:
        for file, data in files.items():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_bytes(data)
        library = _compile([*command, "-o", "library", main, *libraries], folder, limit)
        if missing := _missing_exports(library.read_bytes(), exports):
            raise CompilerFailed(
                f"{shlex.join(command[:1])} failed: it ended without an error, but what it made is no library "
                f"that has {missing[0]}"
            )
        return _keep(library, stem)


def _compile(command: Sequence[str], folder: Path, limit: float) -> Path:
    """Compile a library in a folder, so that it contains no local path."""
    options: dict[str, Any] = {"capture_output": True, "text": True, "errors": "replace", "timeout": limit}
    options["env"] = {**os.environ, **cache_environment()}
    try:
        run = subprocess.run(command, cwd=folder, stdin=subprocess.DEVNULL, **options)
    except subprocess.TimeoutExpired:
        raise CompilerFailed(f"{command[0]} was not done in {limit:g} s") from None
    except OSError as error:
        raise CompilerFailed(f"{command[0]}: {error!s}") from error
    library = folder / "library"
    if run.returncode or not library.is_file():
        output, name = (run.stderr or run.stdout).strip(), shlex.join(command[:1])
        lines = output.splitlines()
        line = next((line for line in lines if "error" in line.lower()), lines[-1] if lines else "")
        if run.returncode:
            raise CompilerFailed(f"{name} failed: {line or 'it says nothing'}", output)
        raise CompilerFailed(
            f"{name} failed: it ended without an error and made no library{line and f'; it said {line}'}", output
        )
    return library


def _missing_exports(library: bytes, exports: Sequence[str]) -> list[str]:
    """Return required functions missing in a library."""
    if library.startswith(PACKED):  # names are stored as a tree of parts
        return []
    return [name for name in exports if not library.startswith(PLAIN) or name.encode() + b"\0" not in library]


def load_library(source: str, *headers: Path) -> ctypes.CDLL:
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
            library = library_of(files, "model.c", full)
            try:
                return ctypes.CDLL(str(library))
            except OSError:
                library.unlink(missing_ok=True)
                return ctypes.CDLL(str(library_of(files, "model.c", full)))
        except (CompilerFailed, OSError) as error:
            reason = reason or error
    if reason is None:
        raise NoCompiler("no C compiler is found in CC or on PATH")
    raise CompilerFailed(str(reason)) from reason


def _keep(library: Path, stem: Path) -> Path:
    """Copy a library into the cache, completely or not at all."""
    path = _cache_path(stem, library)
    with draft_of(path) as draft:
        shutil.copyfile(library, draft)
    return path


def _cache_path(stem: Path, library: Path) -> Path:
    """Return the cache path for a library's content."""
    return stem.with_name(f"{stem.name}-{hashlib.sha256(library.read_bytes()).hexdigest()[:32]}.so")
