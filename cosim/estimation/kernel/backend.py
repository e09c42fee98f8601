"""Cache of compiled kernels by model and measured outputs."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cosim.core.errors import Fault, InputError
from cosim.estimation.kernel.c_filter import CompiledKernel
from cosim.estimation.kernel.generate import generate, generate_stepped
from cosim.estimation.kernel.kernel import Kernel
from cosim.estimation.kernel.library_kernel import LibraryOf
from cosim.estimation.kernel.remote_kernel import RemoteLibraryKernel
from cosim.fmi.native.compiler import CompilerFailed, NoCompiler, cure
from cosim.model.model import Model
from cosim.model.symbolic.symbols import OfNumbersOnly
from cosim.terms.fmu_model import FmuModel

_kernels: dict[tuple[Any, ...], Kernel] = {}


def kernel(
    model: Model,
    measured: Sequence[str],
    unnamed: bool = False,
    constant: Sequence[str] = (),
    fmu: LibraryOf | None = None,
) -> Kernel:
    """Return the kernel (Kalman filter over a log) for a model and its measured outputs, compiled or from the cache.

    Boolean parameters are compiled in; the kernel takes all others as arguments.

    Args:
        unnamed: Whether to add terms outside the catalogue, as in `generate`.
        constant: Parameters that the filter treats as constant states.
        fmu: FMU of a model whose equations are in a library.

    Raises:
        InputError: No working C compiler exists, or the model compares symbols with ==.
    """
    flags = tuple(getattr(model, p.name) for p in model.parameters if isinstance(p.default, bool))
    key = (type(model), flags, tuple(measured), unnamed, tuple(constant), model.integrator)
    if key not in _kernels:
        try:
            if isinstance(model, FmuModel) and fmu is not None:
                generated = (generate_stepped if model.stepped else generate)(model, measured, unnamed)
                _kernels[key] = RemoteLibraryKernel(generated, fmu)
            else:
                _kernels[key] = CompiledKernel(generate(model, measured, unnamed, constant))
        except OfNumbersOnly as error:
            line = traceback.extract_tb(error.__traceback__)[-2]  # the model's line of the operation
            place = Path(line.filename), line.lineno or 0, (line.colno or 0) + 1
            raise InputError(
                [
                    Fault(
                        *place,
                        "this line works on numbers only, and refine replaces numbers by symbols to compile "
                        f"it: {error}",
                    )
                ]
            ) from error
        except (NoCompiler, CompilerFailed) as error:
            message = f"refine compiles its filter with a C compiler, but {error}; {cure('refine')}"
            raise InputError.at(Path(sys.executable), message) from error
    return _kernels[key]
