"""What pythonfmu 0.7.0 releases once too often, put right from within the FMU.

It runs the slave's script once when it imports it and once more at every instantiation, after which it
releases the module's dictionary, which it does not own: the dictionary is freed while in use, and the
host crashes at a later collection or at its end.

Its Linux library releases the keeper of its interpreter twice as the process ends, the second time in
memory that is free by then, which now and then aborts a host that has done its work. Where the keeper is
let go of before, both do nothing. An FMU of ours sees to it in any Python host; `cosim` does for anybody's FMU.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_libraries: set[Path] = set()


def keep(module: dict[str, Any], names: Mapping[str, Any]) -> None:
    """Called by the slave's script, at each run of it, with its `globals()` and `locals()`."""
    if names is not module:  # a run for an instantiation, not the import
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(module))
        # an interpreter that the library itself started, which has no command line, is ended by the keeper
        if sys.orig_argv:
            # the library has just put its resources there; the module may be that of another extraction
            let_go_at_exit(Path(sys.path[0]).parent)


def let_go_at_exit(folder: Path) -> None:
    """Let go of the keeper of every library of pythonfmu loaded from the FMU unpacked in `folder`, once each."""
    if not sys.platform.startswith("linux"):
        return
    for file in set(folder.glob("binaries/linux64/*.so")) - _libraries:
        _libraries.add(file)
        try:
            library = ctypes.CDLL(str(file), mode=os.RTLD_NOLOAD | os.RTLD_LAZY)
            atexit.register(library.finalizePythonInterpreter)
        except (OSError, AttributeError):  # loaded from elsewhere, or by a pythonfmu that does without
            continue
