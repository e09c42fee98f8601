"""Reasons and remedies for a library that does not load.

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

from cosim.base.messages import Message
from cosim.blocks import messages

ELF, POINTER_OF_LFS = b"\x7fELF", b"version https://git-lfs"
OTHER_SYSTEMS = {
    b"MZ": "Windows",
    **dict.fromkeys((b"\xcf\xfa\xed\xfe", b"\xce\xfa\xed\xfe", b"\xca\xfe\xba\xbe"), "macOS"),
}
PROCESSORS = {3: "x86", 8: "MIPS", 21: "PowerPC", 40: "ARM", 62: "x86-64", 183: "AArch64", 243: "RISC-V"}
MACHINES = {"x86_64": 62, "amd64": 62, "i386": 3, "i686": 3, "aarch64": 183, "arm64": 183, "riscv64": 243}
BITS = {1: 32, 2: 64}
MISSING = re.compile(r"(?P<file>[^\s:/]+): cannot open shared object file: No such file")
TOO_NEW = re.compile(r"version `(?P<name>[A-Z]+)_(?P<version>[\d.]+)' not found")
SYMBOL = re.compile(r"undefined symbol: (?P<name>[^\s,]+)")
MAKERS = {"GLIBC": "glibc", "GLIBCXX": "libstdc++", "CXXABI": "libstdc++", "GCC": "libgcc"}


def load_error(library: Path, error: Exception, *, hidden: bool = False) -> Message:
    """Return the reason in a line, with the remedy, unless libraries that the process hides are a reason."""
    text = " ".join(str(error).split())
    text = text.removeprefix(f"Failed to load shared library {library}. ")  # FMPy's prefix
    text = re.sub(rf"{re.escape(str(library.parent))}/?", "", text)
    return header_fault(library) or _loader_fault(library.name, text, error, hidden)


def header_fault(library: Path) -> Message | None:
    """Return a library file's misfit with this machine.

    Only Linux files are examined; on other systems the loader's own text is clear.
    """
    if platform.system() != "Linux":
        return None
    name = library.name
    try:
        with library.open("rb") as stream:
            head = stream.read(64)
    except OSError as error:
        return messages.UNREADABLE_LIBRARY(library=name, reason=error.strerror)
    if head.startswith(POINTER_OF_LFS):
        return messages.GIT_LFS_POINTER(library=name)
    for magic, system in OTHER_SYSTEMS.items():
        if head.startswith(magic):
            return messages.OTHER_SYSTEM(library=name, system=system)
    if len(head) < 20 or not head.startswith(ELF):
        return messages.NOT_A_LIBRARY(library=name, head=head[:8].hex(" ") or "nothing")
    bits, own_bits = BITS.get(head[4], 0), 8 * struct.calcsize("P")
    if bits != own_bits:
        return messages.OTHER_WORD_SIZE(library=name, bits=bits, own=own_bits)
    (processor,) = struct.unpack_from("<H" if head[5] == 1 else ">H", head, 18)
    own = MACHINES.get(platform.machine().lower())
    if own is not None and processor != own:
        other = PROCESSORS.get(processor, f"processor {processor}")
        return messages.OTHER_PROCESSOR(library=name, processor=other, own=PROCESSORS[own])
    return None


def _loader_fault(name: str, text: str, error: Exception, hidden: bool) -> Message:
    """Return the message for a text of the loader, with the remedy of a known cause."""
    if hidden and not isinstance(error, AttributeError) and (TOO_NEW.search(text) or SYMBOL.search(text)):
        return messages.LOADER_ERROR(library=name, reason=text)
    if match := TOO_NEW.search(text):
        own = ""
        if sys.platform == "linux" and match["name"] == "GLIBC":
            own = f", this machine has {os.confstr('CS_GNU_LIBC_VERSION')}"
        package = MAKERS.get(match["name"], match["name"])
        return messages.OLD_SYSTEM(library=name, name=package, version=match["version"], own=own, reason=text)
    if (match := MISSING.search(text)) and isinstance(_cause(error), OSError):
        return messages.MISSING_DEPENDENCY(library=name, file=match["file"], reason=text)
    if match := SYMBOL.search(text):
        if isinstance(error, AttributeError):  # The library is loaded, but an FMI function is missing.
            return messages.MISSING_FUNCTION(library=name, function=match["name"], reason=text)
        return messages.MISSING_SYMBOL(library=name, symbol=match["name"], reason=text)
    if _is_execution_refused(text):
        return messages.FOLDER_NOT_EXECUTABLE(library=name, reason=text)
    return messages.LOADER_ERROR(library=name, reason=text)


def _is_execution_refused(text: str) -> bool:
    if "Operation not permitted" in text or "Permission denied" in text:
        return True
    return "failed to map segment" in text and _is_without_programs(tempfile.gettempdir())


def _is_without_programs(folder: str) -> bool:
    """Return whether the folder's disk is mounted noexec."""
    return sys.platform == "linux" and bool(os.statvfs(folder).f_flag & os.ST_NOEXEC)


def _cause(error: Exception) -> BaseException:
    """Return the error behind FMPy's bare Exception."""
    return error.__context__ if error.__context__ is not None and type(error) is Exception else error
