"""Libraries that are not installed with the core: one message that says how to install them."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from cosim.base.errors import Fault, InputError

DISTRIBUTION = "fmu-cosim"
EXTRAS = {  # library → the extra that installs it
    "SALib": "sweep",
    "distributed": "dask",
    "pandas": "sweep",
    "pyarrow": "parquet",
    "ziglang": "native",
}


def optional(module: str, place: str | Callable[[str], Fault]) -> Any:
    """Return an optional library, imported now; InputError that says how to install it.

    module: its name, such as `pyarrow.parquet`
    place:  subject of the message, such as a command; or a function that puts the message at its place in a file
    """
    name = module.partition(".")[0]
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != name:
            raise
        message = f"needs {name}, which is not installed: {install_command(EXTRAS[name])}"
        fault = Fault(Path(place), 0, 0, message) if isinstance(place, str) else place(message)
        raise InputError([fault]) from None


def install_command(extra: str) -> str:
    """Return the command that installs an extra."""
    return f"pip install '{DISTRIBUTION}[{extra}]'"
