"""Reasons and remedies for a library that does not load.

For a library of another processor the loader reports only "no such file", so the header is examined first.
"""

from __future__ import annotations

import os
import platform
import re
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path

ELF, POINTER_OF_LFS = b"\x7fELF", b"version https://git-lfs"
OTHER_SYSTEMS = {
    b"MZ": "Windows",
    **dict.fromkeys((b"\xcf\xfa\xed\xfe", b"\xce\xfa\xed\xfe", b"\xca\xfe\xba\xbe"), "macOS"),
}
PROCESSORS = {3: "x86", 8: "MIPS", 21: "PowerPC", 40: "ARM", 62: "x86-64", 183: "AArch64", 243: "RISC-V"}
HERE = {"x86_64": 62, "amd64": 62, "i386": 3, "i686": 3, "aarch64": 183, "arm64": 183, "riscv64": 243}
BITS = {1: 32, 2: 64}
EXPORT = "export the FMU for this platform"
MISSING = re.compile(r"(?P<file>[^\s:/]+): cannot open shared object file: No such file")
TOO_NEW = re.compile(r"version `(?P<name>[A-Z]+)_(?P<version>[\d.]+)' not found")
SYMBOL = re.compile(r"undefined symbol: (?P<name>[^\s,]+)")
MAKERS = {"GLIBC": "glibc", "GLIBCXX": "libstdc++", "CXXABI": "libstdc++", "GCC": "libgcc"}


def load_error(library: Path, error: Exception) -> str:
    """Return the reason in a line, with the remedy."""
    text = " ".join(str(error).split())
    text = text.removeprefix(f"Failed to load shared library {library}. ")  # FMPy's prefix
    text = re.sub(rf"{re.escape(str(library.parent))}/?", "", text)
    reason = header_fault(library)
    if reason is None:
        reason = next((told for cause in _CAUSES if (told := cause(text, error))), text)
    return f"its library {library.name}: {reason}"


def header_fault(library: Path) -> str | None:
    """Return a misfit of a library file with this machine.

    Only Linux files are examined; on other systems the loader's own text is clear.
    """
    if platform.system() != "Linux":
        return None
    try:
        with library.open("rb") as stream:
            head = stream.read(64)
    except OSError as error:
        return f"cannot be read: {error.strerror}"
    if head.startswith(POINTER_OF_LFS):
        return 'is a pointer of git-lfs, not the file itself; "git lfs pull" in its repository brings it'
    for magic, system in OTHER_SYSTEMS.items():
        if head.startswith(magic):
            return f"is made for {system}, though its folder is that of Linux; {EXPORT}"
    if len(head) < 20 or not head.startswith(ELF):
        return f"is no library (it begins with {head[:8].hex(' ') or 'nothing'}); {EXPORT}"
    bits, ours = BITS.get(head[4], 0), 8 * struct.calcsize("P")
    (processor,) = struct.unpack_from("<H" if head[5] == 1 else ">H", head, 18)
    own = HERE.get(platform.machine().lower())
    if bits != ours:
        return f"has {bits} bits (wrong ELF class), this Python {ours}; {EXPORT}"
    if own is not None and processor != own:
        made = PROCESSORS.get(processor, f"processor {processor}")
        return f"is made for {made}, this machine is {PROCESSORS[own]}; {EXPORT}"
    return None


def _missing_library(text: str, error: Exception) -> str | None:
    match = MISSING.search(text)
    if match is None or not isinstance(_cause(error), OSError):
        return None
    cure = f"install the package that has {match['file']}, or name its folder in LD_LIBRARY_PATH"
    return f"needs {match['file']}, which is not on this machine ({text}); {cure}"


def _too_new(text: str, error: Exception) -> str | None:
    match = TOO_NEW.search(text)
    if match is None:
        return None
    maker, here = MAKERS.get(match["name"], match["name"]), ""
    if match["name"] == "GLIBC" and hasattr(os, "confstr"):
        here = f", this machine has {os.confstr('CS_GNU_LIBC_VERSION')}"
    cure = "run it on a newer system, or have the FMU built on an older one"
    return f"needs {maker} {match['version']}{here} ({text}); {cure}"


def _missing_function(text: str, error: Exception) -> str | None:
    match = SYMBOL.search(text)
    if match is None:
        return None
    if isinstance(error, AttributeError):  # The library is loaded, but an FMI function is missing.
        return f"has no function {match['name']}, which FMI demands ({text}); {EXPORT} with a tool that writes it"
    cure = "the FMU was linked without the library that has it: export it again, with that library"
    return f"needs {match['name']}, which no library that it names has ({text}); {cure}"


def _not_executable(text: str, error: Exception) -> str | None:
    refused = "Operation not permitted" in text or "Permission denied" in text
    if not refused and not ("failed to map segment" in text and _is_without_programs(tempfile.gettempdir())):
        return None
    cure = "set TMPDIR to a folder in which programs may be executed (not mounted noexec)"
    return f"may not be executed where FMUs are unpacked ({text}); {cure}"


def _is_without_programs(folder: str) -> bool:
    """Return whether the folder's disk is mounted noexec."""
    return hasattr(os, "statvfs") and bool(os.statvfs(folder).f_flag & os.ST_NOEXEC)


def _cause(error: Exception) -> BaseException:
    """Return the error behind FMPy's bare Exception."""
    return error.__context__ if error.__context__ is not None and type(error) is Exception else error


_CAUSES: tuple[Callable[[str, Exception], str | None], ...] = (
    _too_new,
    _missing_library,
    _missing_function,
    _not_executable,
)
