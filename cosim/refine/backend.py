"""Which kernel this machine runs: C where a compiler is present and works, else numba; the numbers are the same."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence

from cosim.refine.compiled import CompiledKernel, compiler
from cosim.refine.generate import generate
from cosim.refine.jit import JitKernel
from cosim.refine.kernel import ArrayKernel
from cosim.refine.languages import C, Python
from plant.model import Model


def kernel(model: Model, measured: Sequence[str], unnamed: bool = False) -> ArrayKernel:
    """The kernel of a model and the outputs a log holds. Raises InputError where neither C nor numba is to be had."""
    if compiler() is not None:
        try:
            return CompiledKernel(generate(model, measured, C(), unnamed))
        except (OSError, subprocess.SubprocessError):
            pass  # a compiler that does not work is no compiler
    return JitKernel(generate(model, measured, Python(), unnamed))
