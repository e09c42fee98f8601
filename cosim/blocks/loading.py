"""Reasons and cures for a library that does not load.

For a library of another processor the loader reports only "no such file", so the header is examined first.
"""

from __future__ import annotations

import os
import platform
import re
import struct
import sys
import tempfile
from pathlib import Path

ELF, POINTER_OF_LFS = b"\x7fELF", b"version https://git-lfs"
OTHER_SYSTEMS = {
    b"MZ": "Windows",
    **dict.fromkeys((b"\xcf\xfa\xed\xfe", b"\xce\xfa\xed\xfe", b"\xca\xfe\xba\xbe"), "macOS"),
}
PROCESSORS = {3: "x86", 8: "MIPS", 21: "PowerPC", 40: "ARM", 62: "x86-64", 183: "AArch64", 243: "RISC-V"}
MACHINES = {"x86_64": 62, "amd64": 62, "i386": 3, "i686": 3, "aarch64": 183, "arm64": 183, "riscv64": 243}
BITS = {1: 32, 2: 64}
MISSING_LIBRARY = re.compile(r"(?P<file>[^\s:/]+): cannot open shared object file: No such file")
TOO_NEW = re.compile(r"version `(?P<name>[A-Z]+)_(?P<version>[\d.]+)' not found")
UNDEFINED_SYMBOL = re.compile(r"undefined symbol: (?P<name>[^\s,]+)")
MAKERS = {"GLIBC": "glibc", "GLIBCXX": "libstdc++", "CXXABI": "libstdc++", "GCC": "libgcc"}


def load_error(library: Path, error: Exception, *, hidden: bool = False) -> str:
    """Return one line with the reason why a library does not load, and the cure.

    Args:
        hidden: True if equally named code of the process may be the reason; no other cure is then given for a missing
            or too old version or symbol.
    """
    text = " ".join(str(error).split())
    text = text.removeprefix(f"Failed to load shared library {library}. ")  # FMPy's prefix
    text = re.sub(rf"{re.escape(str(library.parent))}/?", "", text)
    fault = _header_fault(library) or _loader_fault(text, error, hidden)
    return f"its library {library.name}: {fault}"


def _header_fault(library: Path) -> str | None:
    """Return why a library file does not fit this machine, from its header; None if it fits.

    Only Linux files are examined; on other systems, the loader's own message is clear.
    """
    if platform.system() != "Linux":
        return None
    try:
        with library.open("rb") as stream:
            head = stream.read(64)
    except OSError as error:
        return f"cannot be read: {error.strerror}"
    if head.startswith(POINTER_OF_LFS):
        return 'is a pointer of git-lfs, not the file itself; run "git lfs pull" in its repository'
    for magic, system in OTHER_SYSTEMS.items():
        if head.startswith(magic):
            return f"is made for {system}, but lies in the folder for Linux; export the FMU for this platform"
    if len(head) < 20 or not head.startswith(ELF):
        return f"is no library (it begins with {head[:8].hex(' ') or 'nothing'}); export the FMU for this platform"
    bits, own_bits = BITS.get(head[4], 0), 8 * struct.calcsize("P")
    if bits != own_bits:
        return f"has {bits} bits (wrong ELF class), but this Python has {own_bits}; export the FMU for this platform"
    (processor,) = struct.unpack_from("<H" if head[5] == 1 else ">H", head, 18)
    own = MACHINES.get(platform.machine().lower())
    if own is not None and processor != own:
        other = PROCESSORS.get(processor, f"processor {processor}")
        return f"is made for {other}, but this machine is {PROCESSORS[own]}; export the FMU for this platform"
    return None


def _loader_fault(text: str, error: Exception, hidden: bool) -> str:
    """Return the message for a text of the loader, with the remedy of a known cause."""
    if hidden and not isinstance(error, AttributeError) and (TOO_NEW.search(text) or UNDEFINED_SYMBOL.search(text)):
        return text
    if match := TOO_NEW.search(text):
        own = ""
        if sys.platform == "linux" and match["name"] == "GLIBC":
            own = f", this machine has {os.confstr('CS_GNU_LIBC_VERSION')}"
        package = MAKERS.get(match["name"], match["name"])
        return (
            f"needs {package} {match['version']}{own} ({text}); run it on a newer system, or "
            "export the FMU on an older system"
        )
    # FMPy raises a bare Exception.
    cause = error.__context__ if error.__context__ is not None and type(error) is Exception else error
    if (match := MISSING_LIBRARY.search(text)) and isinstance(cause, OSError):
        return (
            f"needs {match['file']}, which is not on this machine ({text}); install the "
            f"package that contains it, or add its folder to LD_LIBRARY_PATH"
        )
    if match := UNDEFINED_SYMBOL.search(text):
        if isinstance(error, AttributeError):  # The library is loaded, but an FMI function is missing.
            return (
                f"has no function {match['name']}, which FMI requires ({text}); export the "
                "FMU again with a tool that includes this function"
            )
        return (
            f"needs {match['name']}, which no library linked to it defines ({text}); export the FMU "
            "again, linked to the library that defines it"
        )
    is_refused = "Operation not permitted" in text or "Permission denied" in text
    if "failed to map segment" in text and sys.platform == "linux":
        is_refused |= bool(os.statvfs(tempfile.gettempdir()).f_flag & os.ST_NOEXEC)
    if is_refused:
        return (
            f"may not be executed where FMUs are unpacked ({text}); set TMPDIR to a folder "
            "in which programs may be executed (not mounted noexec)"
        )
    return text
