"""Platforms that a native FMU may hold a library for: their folders, suffixes and compiler targets."""

from __future__ import annotations

import platform
import re
import sys
from dataclasses import dataclass


@dataclass(frozen=True)
class Platform:
    """Folders of FMI 2.0 and 3.0 below `binaries`, how a library ends, and the target as zig calls it."""

    name: str
    fmi3: str
    suffix: str
    target: str

    @property
    def position(self) -> list[str]:
        """Options for code that may lie anywhere in memory; on Windows all code may."""
        return [] if self.suffix == ".dll" else ["-fPIC"]

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


def glibc_floor(library: bytes) -> str:
    """The oldest glibc that a library of Linux runs on, by the versions of the symbols it binds; "" without any."""
    found = {tuple(map(int, v.split(b"."))) for v in re.findall(rb"GLIBC_(\d+(?:\.\d+)+)", library)}
    return ".".join(map(str, max(found))) if found else ""
