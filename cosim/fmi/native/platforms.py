"""Platforms that a native FMU may hold a library for: their folders, and the compilers that reach them."""

from __future__ import annotations

import importlib.util
import platform
import re
import sys
from dataclasses import dataclass

from cosim.base.extras import install_command
from cosim.fmi.native.compiler import compiler

OPTIONS = ("-std=c99", "-O3", "-fno-math-errno", "-ffp-contract=off", "-fvisibility=hidden", "-shared")
CURE = f"install gcc or clang, say which in CC, or {install_command('native')}"


class NoCompiler(LookupError):
    """There is none for a platform: which, and the cure."""


@dataclass(frozen=True)
class Platform:
    """Folders of FMI 2.0 and 3.0 below `binaries`, how a library ends, and the target as zig calls it."""

    name: str
    fmi3: str
    suffix: str
    target: str

    def folder(self, fmi: int) -> str:
        """Below `binaries`; FMI 2.0.4 takes the names of 3.0 for what it has no own name for."""
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


def here() -> Platform | None:
    """The platform of this machine, None of one that is not in the list."""
    system = {"linux": "linux", "win32": "windows", "darwin": "darwin"}.get(sys.platform, sys.platform)
    machine = {"AMD64": "x86_64", "arm64": "aarch64"}.get(platform.machine(), platform.machine())
    return next((p for p in PLATFORMS.values() if p.fmi3 == f"{machine}-{system}"), None)


def crossing() -> bool:
    """Whether the compiler that crosses to other platforms is installed (the extra `native`)."""
    return importlib.util.find_spec("ziglang") is not None


def commands(asked: tuple[str, ...] = ()) -> dict[Platform, list[str]]:
    """Platform → the command that makes its library; without any asked for, this machine's own.

    KeyError on a name that is none; NoCompiler.
    """
    own = here()
    if own is None and not asked:
        raise NoCompiler(f"this machine, {platform.machine()} {sys.platform}, is none of {', '.join(PLATFORMS)}")
    wanted = [PLATFORMS[name] for name in asked] or [p for p in PLATFORMS.values() if p == own]
    return {p: [*_compiler(p, p == own, bool(asked)), *OPTIONS, *_position(p)] for p in wanted}


def library_command() -> list[str]:
    """The command that makes a library of this machine, without a language or an optimization; NoCompiler."""
    own = here()
    if own is None:
        command = compiler()
        if command is None:
            raise NoCompiler(f"no C compiler is found; {CURE}")
        return [*command, "-shared", "-fPIC"]
    return [*_compiler(own, own=True, asked=False), "-shared", *_position(own)]


def _compiler(wanted: Platform, own: bool, asked: bool) -> list[str]:
    """This machine's compiler for itself, the one that crosses for the others and for old versions of glibc."""
    local = compiler() if own else None
    if crossing() and (asked or local is None):
        return [sys.executable, "-m", "ziglang", "cc", "-target", wanted.target, "-s"]
    if local is not None:
        return local
    if own:
        raise NoCompiler(f"no C compiler is found; {CURE}")
    cure = f"{install_command('native')}, which brings a compiler that crosses"
    raise NoCompiler(f"no compiler for {wanted.name} is found; {cure}")


def _position(wanted: Platform) -> list[str]:
    """Code of a library may lie anywhere; on Windows all of it may."""
    return [] if wanted.suffix == ".dll" else ["-fPIC"]


def glibc_floor(library: bytes) -> str:
    """The oldest glibc that a library of Linux runs on, by the versions of the symbols it binds; "" without any."""
    found = {tuple(map(int, v.split(b"."))) for v in re.findall(rb"GLIBC_(\d+(?:\.\d+)+)", library)}
    return ".".join(map(str, max(found))) if found else ""
