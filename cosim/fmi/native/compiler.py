"""C compilers of this machine or from pip, their target platforms, and compiled libraries."""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from cosim.core.drafts import draft_of
from cosim.core.extras import install_command
from cosim.core.scratch import temporary_folder
from cosim.files.cache import cache_environment, cache_path

# -fno-math-errno: errno after sin and pow is never read
OPTIONS = ("-std=c99", "-O3", "-fno-math-errno", "-ffp-contract=off", "-shared")
POSITION = [] if sys.platform == "win32" else ["-fPIC"]  # option for code of libraries on this machine
COMPILER_TIMEOUT_S = 900.0  # time limit of the compiler [s]
ZIG = "ziglang"  # C compiler for every platform, on PyPI


@dataclass(frozen=True)
class Platform:
    """A target platform: folders below `binaries` in FMI 2.0 and 3.0, library suffix, and name for the compiler zig."""

    name: str
    fmi3: str
    suffix: str
    target: str

    def folder(self, fmi: int) -> str:
        """Return the platform's folder below `binaries` for a version of FMI.

        A platform without a name in FMI 2.0 uses its FMI 3.0 name, as in FMI 2.0.4.
        """
        return self.name if fmi == 2 else self.fmi3


PLATFORMS = {
    p.name: p
    for p in (
        Platform("linux64", "x86_64-linux", ".so", "x86_64-linux-gnu.2.17"),
        Platform("win64", "x86_64-windows", ".dll", "x86_64-windows-gnu"),
        Platform("darwin64", "x86_64-darwin", ".dylib", "x86_64-macos"),
        Platform("aarch64-linux", "aarch64-linux", ".so", "aarch64-linux-gnu.2.17"),
        Platform("aarch64-darwin", "aarch64-darwin", ".dylib", "aarch64-macos"),
    )
}


def this_platform() -> Platform | None:
    """Return the platform of this machine; None if it is not in `PLATFORMS`."""
    import fmpy

    return next((p for p in PLATFORMS.values() if p.fmi3 == fmpy.platform_tuple), None)


def glibc_floor(library: bytes) -> str:
    """Return the oldest version of glibc with which a Linux library runs, from the versions of its symbols."""
    versions = {tuple(map(int, v.split(b"."))) for v in re.findall(rb"GLIBC_(\d+(?:\.\d+)+)", library)}
    return ".".join(map(str, max(versions, default=())))


class NoCompiler(LookupError):
    """There is no compiler for a platform; the message says how to install one."""


class CompilerFailed(RuntimeError):
    """A compilation failed: the message in one line; `output` has the compiler's full text."""

    def __init__(self, reason: str, output: str = "") -> None:
        super().__init__(reason)
        self.output = output


def compiler() -> list[str] | None:
    """Return the command of the C compiler for this machine; None if there is none.

    `CC` in the environment names a compiler; otherwise cc, gcc or clang is used, otherwise zig from the extra `refine`.
    """
    choice, machine = os.environ.get("CC"), this_platform()
    for name in ("cc", "gcc", "clang") if choice is None else (choice,):
        with suppress(ValueError):  # CC has an unclosed quote
            if (words := shlex.split(name)) and shutil.which(words[0]):
                return words
    return cross_command(machine) if machine and can_cross() else None


def can_cross() -> bool:
    """Return True if the cross compiler zig is installed (extras `refine`, `native`)."""
    return importlib.util.find_spec(ZIG) is not None


def cross_command(target: Platform) -> list[str]:
    """Return the command of the cross compiler for a platform."""
    return [sys.executable, "-m", ZIG, "cc", "-target", target.target, "-s"]


def commands(names: Sequence[str] = ()) -> dict[Platform, list[str]]:
    """Return platform → command of its compiler, for the named platforms or, by default, for this machine.

    Named platforms use the cross compiler, which also supports old versions of glibc. So does this machine if it has no
    other compiler.

    Raises:
        KeyError: A platform is unknown.
        NoCompiler: A compiler is missing.
    """
    machine, found = this_platform(), {}
    if machine is None and not names:
        fault = f"this machine, {platform.machine()} {sys.platform}, is none of {', '.join(PLATFORMS)}"
        raise NoCompiler(f"{fault}; give one of these")
    for target in [PLATFORMS[name] for name in names] or [p for p in PLATFORMS.values() if p == machine]:
        if can_cross() and (names or compiler() is None):
            command = cross_command(target)
        elif target == machine:
            command = required_compiler()
        else:
            install = f"{install_command('native')} (a cross compiler)"
            raise NoCompiler(f"no compiler for {target.name} was found; {install}")
        options = ["-fvisibility=hidden", *(["-fPIC"] if target.suffix != ".dll" else [])]
        found[target] = [*command, *OPTIONS, *options]
    return found


def fmi_headers() -> Path:
    """Return FMPy's folder of FMI headers."""
    import fmpy

    return Path(fmpy.__file__).with_name("c-code")


def cure(extra: str) -> str:
    """Return how to install a C compiler, as part of a message."""
    return f"install gcc or clang, name a compiler in CC, or {install_command(extra)}"


def required_compiler() -> list[str]:
    """Return the C compiler's command; raise NoCompiler if there is none."""
    if (command := compiler()) is None:
        raise NoCompiler(f"no C compiler was found in CC or on PATH; {cure('native')}")
    return command


def library_of(
    files: Mapping[str, bytes],
    main: str,
    command: Sequence[str],
    *,
    libraries: Sequence[str] = ("-lm",),
    limit: float = COMPILER_TIMEOUT_S,
) -> Path:
    """Return the cached path of a compiled shared library.

    The name of the file ends with a hash of its content, so that a damaged library is not loaded.

    Args:
        files: Contents by path below the compiler's folder.
        main: Path of the file to compile.
        command: Command of the compiler.
        limit: Time limit of the compiler [s].

    Raises:
        CompilerFailed: Compilation failed.
    """
    content = hashlib.sha256(repr((sorted(files.items()), main, list(command), *libraries)).encode()).hexdigest()
    stem = cache_path(content, "")

    def path_of(data: bytes) -> Path:
        return stem.with_name(f"{stem.name}-{hashlib.sha256(data).hexdigest()[:32]}.so")

    for library in stem.parent.glob(f"{stem.name}-*.so"):
        data = library.read_bytes()
        if library == path_of(data):
            return library
        library.unlink(missing_ok=True)
    data, name = b"", shlex.join(command[:1])
    with temporary_folder("compile") as folder:  # working folder of the compiler, so that the library has no local path
        for file, source in files.items():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_bytes(source)
        try:
            run = subprocess.run(
                [*command, "-o", "library", main, *libraries],
                cwd=folder,
                env={**os.environ, **cache_environment()},
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=limit,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise CompilerFailed(f"{command[0]} did not finish within {limit:g} s") from None
        except OSError as error:
            raise CompilerFailed(f"{command[0]}: {error!s}") from error
        if run.returncode == 0 and (folder / "library").is_file():
            data = (folder / "library").read_bytes()
    if not data:
        output = (run.stderr or run.stdout).strip()
        lines = output.splitlines() or ["it printed no message and wrote no library"]
        line = next((line for line in lines if "error" in line.lower()), lines[-1])
        raise CompilerFailed(f"{name} failed: {line}", output)
    with draft_of(path_of(data)) as draft:
        draft.write_bytes(data)
    return path_of(data)


def load_library(source: str, *headers: Path) -> ctypes.CDLL:
    """Compile source and headers for this machine, and return the loaded library.

    A library is compiled again if the cached one does not load on this machine.

    Raises:
        NoCompiler: No compiler exists.
        CompilerFailed: The compiler fails.
    """
    files = {"model.c": source.encode(), **{path.name: path.read_bytes() for path in headers}}
    command = [*required_compiler(), *OPTIONS, *POSITION]
    library = library_of(files, "model.c", command)
    with suppress(OSError):
        return ctypes.CDLL(str(library))
    library.unlink(missing_ok=True)
    try:
        return ctypes.CDLL(str(library_of(files, "model.c", command)))
    except OSError as error:
        raise CompilerFailed(f"{command[0]} built a library that does not load: {error}") from error
