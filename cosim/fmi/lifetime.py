"""Workaround for pythonfmu 0.7.0, which releases two objects twice and thereby crashes the host of an FMU.

pythonfmu runs the slave's script at import and again at every instantiation. It then releases the module's dictionary
without owning a reference: the dictionary is freed while in use, and the host crashes at a later garbage collection or
at exit. The Linux library also releases its interpreter guard twice at process end, the second time in freed memory,
which sometimes aborts a finished host. An additional reference makes both releases harmless. cosim's FMUs take it in
any Python host; `cosim` takes it for any FMU.
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
    """Protect the module's dictionary; called by the slave's script.

    Args:
        module: The script's `globals()`.
        names: The script's `locals()`.
    """
    if names is not module:  # an instantiation, not the import
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(module))
        # An interpreter started by the library itself has no command line, and the guard ends it.
        if sys.orig_argv:
            # The library has just inserted its resources; the module may come from another extraction.
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
        except (OSError, AttributeError):  # loaded from elsewhere, or by a pythonfmu without keeper
            continue
