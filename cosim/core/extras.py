"""Import of optional libraries. If a library is missing, the error names the installation command."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from cosim.core.errors import Fault, InputError

DISTRIBUTION = "fmu-cosim"
EXTRAS = {  # library → extra that installs it
    "SALib": "sweep",
    "asammdf": "mdf",
    "cryptography": "sign",
    "distributed": "dask",
    "h5py": "hdf5",
    "openpyxl": "excel",
    "pandas": "sweep",
    "ziglang": "native",
}


def optional(module: str, place: str | Callable[[str], Fault]) -> Any:
    """Import and return an optional library.

    Args:
        module: Module name, e.g. `pyarrow.parquet`.
        place: Command or setting that needs the library, or a function that makes a Fault from the message.

    Raises:
        InputError: The library is not installed; the message says how to install it.
    """
    name = module.partition(".")[0]
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != name:
            raise
        raise _missing(name, place) from None


def check_installed(name: str, place: str) -> None:
    """Raise InputError if an optional library is not installed, without importing the library."""
    if find_spec(name) is None:
        raise _missing(name, place)


def _missing(name: str, place: str | Callable[[str], Fault]) -> InputError:
    message = f"needs {name}, which is not installed: {install_command(EXTRAS[name])}"
    return InputError([Fault(Path(place), 0, 0, message) if isinstance(place, str) else place(message)])


def pandas_for_frames() -> Any:
    """Return pandas; if it is missing, raise ImportError with the installation command."""
    try:
        return import_module("pandas")
    except ImportError:
        raise ImportError("to_pandas needs pandas: pip install pandas") from None


def install_command(extra: str) -> str:
    """Return the command that installs an extra, such as `pip install "cosim[refine]"`."""
    return f"pip install '{DISTRIBUTION}[{extra}]'"
