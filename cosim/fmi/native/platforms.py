"""Platforms of native FMUs: folders, suffixes and compiler targets."""

from __future__ import annotations

import platform
import re
import sys
from dataclasses import dataclass


@dataclass(frozen=True)
class Platform:
    """Folders of FMI 2.0 and 3.0 below `binaries`, library suffix, and zig's target name."""

    name: str
    fmi3: str
    suffix: str
    target: str

    @property
    def position(self) -> list[str]:
        """Return the option for position-independent code, not needed on Windows."""
        return [] if self.suffix == ".dll" else ["-fPIC"]

    def folder(self, fmi: int) -> str:
        """Return the folder below `binaries`. Platforms without a name in FMI 2.0 have that of 3.0, as in 2.0.4."""
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
    """Return this machine's platform, None if not listed."""
    system = {"linux": "linux", "win32": "windows", "darwin": "darwin"}.get(sys.platform, sys.platform)
    machine = {"AMD64": "x86_64", "arm64": "aarch64"}.get(platform.machine(), platform.machine())
    return next((p for p in PLATFORMS.values() if p.fmi3 == f"{machine}-{system}"), None)


def glibc_floor(library: bytes) -> str:
    """Return the oldest version of glibc with which a Linux library runs, from the versions of its symbols."""
    versions = {tuple(map(int, v.split(b"."))) for v in re.findall(rb"GLIBC_(\d+(?:\.\d+)+)", library)}
    return ".".join(map(str, max(versions, default=())))
