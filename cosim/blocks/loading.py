"""Reasons and cures for a library that does not load.

For a library of another processor the loader reports only "no such file", so the header is examined first.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

POINTER_OF_LFS = b"version https://git-lfs"
# of the header of a library or program of Linux: format, 32 or 64 bits and byte order, processor
HEADER_PARTS = slice(0, 6), slice(18, 20)
UNDEFINED_SYMBOL = r"undefined symbol: (?P<name>[^\s,]+)"
PACKAGES = {"glibcxx": "libstdc++", "cxxabi": "libstdc++", "gcc": "libgcc"}  # prefix of versions → library
LOADER_FAULTS = {  # text of the loader → reason and cure
    r"version `(?P<name>[A-Z]+)_(?P<version>[\d.]+)' not found": (
        "needs {package} {version}{here} ({text}); run it on a newer system, or export the FMU on an older system"
    ),
    r"(?P<name>[^\s:/]+): cannot open shared object file: No such file": (
        "needs {name}, which is not on this machine ({text}); install the package that contains it, or add its folder "
        "to LD_LIBRARY_PATH"
    ),
    UNDEFINED_SYMBOL: (
        "needs {name}, which no library linked to it defines ({text}); export the FMU again, linked to the library "
        "that defines it"
    ),
    r"Operation not permitted|Permission denied|failed to map segment(?!.*Cannot allocate)": (
        "may not be executed where FMUs are unpacked ({text}); set TMPDIR to a folder in which programs may be "
        "executed (not mounted noexec)"
    ),
}


def load_error(library: Path, error: Exception) -> str:
    """Return one line with the reason why a library does not load, and the cure."""
    text = " ".join(str(error).split())
    text = text.removeprefix(f"Failed to load shared library {library}. ")  # FMPy's prefix
    text = re.sub(rf"{re.escape(str(library.parent))}/?", "", text)
    prefix = f"its library {library.name}: "
    if sys.platform == "linux":  # on other systems, the loader's own message is clear
        heads = []
        for path in (library, Path("/proc/self/exe")):
            with path.open("rb") as stream:
                heads.append(stream.read(64))
        head, own = heads
        if head.startswith(POINTER_OF_LFS):
            return f'{prefix}is a pointer of git-lfs, not the file itself; run "git lfs pull" in its repository'
        if any(head[part] != own[part] for part in HEADER_PARTS):
            start = head[:20].hex(" ") or "nothing"
            return f"{prefix}is no library for this machine (it begins with {start}); export the FMU for this platform"
    if isinstance(error, AttributeError) and (match := re.search(UNDEFINED_SYMBOL, text)):  # the library is loaded
        cure = "export the FMU again with a tool that includes this function"
        return f"{prefix}has no function {match['name']}, which FMI requires ({text}); {cure}"
    for pattern, reason in LOADER_FAULTS.items():
        if match := re.search(pattern, text):
            names = match.groupdict()
            package = names.get("name", "").lower()
            package = PACKAGES.get(package, package)
            here = f", this machine has {os.confstr('CS_GNU_LIBC_VERSION')}" if package == "glibc" else ""
            return prefix + reason.format(text=text, here=here, package=package, **names)
    return prefix + text
