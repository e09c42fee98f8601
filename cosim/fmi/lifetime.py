"""Workaround for pythonfmu 0.7.0, which releases two objects twice and thereby crashes the host of an FMU.

pythonfmu runs the slave's script at import and again at every instantiation. It then releases the module's dictionary
without owning a reference: the dictionary is freed while in use, and the host crashes at a later garbage collection or
at exit. The Linux library also releases its interpreter guard twice at process end, the second time in freed memory,
which sometimes aborts a finished host. An additional reference to each object makes both releases harmless. FMUs built
by cosim take this reference in any Python host, and `cosim` takes it for every FMU.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

KEEPER = "finalizePythonInterpreter"  # function that releases the keeper of the interpreter
_libraries: set[Path] = set()


def keep(module: dict[str, Any], names: Mapping[str, Any]) -> None:
    """Take an additional reference to the module's dictionary. The slave's script calls this function.

    Args:
        module: The script's `globals()`.
        names: The script's `locals()`.
    """
    if names is not module:  # true at an instantiation, false at the import
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(module))
        # An interpreter that the library itself has started has no command line; the library also ends it.
        if sys.orig_argv:
            # The library has inserted its resources first in sys.path; the module may be from another extraction.
            let_go_at_exit(Path(sys.path[0]).parent)


def let_go_at_exit(folder: Path) -> None:
    """Release the interpreter guard of each library of an unpacked FMU once, at exit."""
    if not sys.platform.startswith("linux"):
        return
    for file in set(folder.glob("binaries/linux64/*.so")) - _libraries:
        _libraries.add(file)
        try:
            library = ctypes.CDLL(str(file), mode=os.RTLD_NOLOAD | os.RTLD_LAZY)
            atexit.register(getattr(library, KEEPER))
        except (OSError, AttributeError):  # the library was loaded from another folder, or its pythonfmu has no guard
            continue
