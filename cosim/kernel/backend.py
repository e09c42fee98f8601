"""Which kernel this machine runs: C where a compiler is present and works, else numba; the numbers are the same."""

from __future__ import annotations

import subprocess
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cosim.base.errors import Fault, InputError
from cosim.fmi.native.compiler import compiler
from cosim.kernel.buffers import ArrayKernel
from cosim.kernel.c_filter import CompiledKernel
from cosim.kernel.generate import generate
from cosim.kernel.jit import JitKernel
from cosim.model.model import Model
from cosim.model.symbolic.languages import C, Python
from cosim.model.symbolic.tracing_guard import OfNumbersOnly

_made: dict[tuple[Any, ...], ArrayKernel] = {}


def kernel(model: Model, measured: Sequence[str], unnamed: bool = False, constant: Sequence[str] = ()) -> ArrayKernel:
    """The kernel of a model and the outputs a log holds, made once: it takes all numbers, flags alone are built in.

    Raises InputError where neither C nor numba is to be had, and where the model decides by == on a symbol.
    """
    flags = tuple(getattr(model, p.name) for p in model.parameters if isinstance(p.default, bool))
    key = (type(model), flags, tuple(measured), unnamed, tuple(constant))
    if key not in _made:
        try:
            _made[key] = _make(model, measured, unnamed, constant)
        except OfNumbersOnly as error:
            raise InputError([_decided(error)]) from error
    return _made[key]


def _decided(error: OfNumbersOnly) -> Fault:
    """A fault at the line of the model that the guard was called from."""
    line = traceback.extract_tb(error.__traceback__)[-2]
    return Fault(Path(line.filename), line.lineno or 0, (line.colno or 0) + 1, f"cannot be made of symbols: {error}")


def _make(model: Model, measured: Sequence[str], unnamed: bool, constant: Sequence[str]) -> ArrayKernel:
    if compiler() is not None:
        try:
            return CompiledKernel(generate(model, measured, C(), unnamed, constant))
        except (OSError, subprocess.SubprocessError):
            pass  # a compiler that does not work is no compiler
    return JitKernel(generate(model, measured, Python(), unnamed, constant))
