"""The filter without a C compiler: generated Python, compiled by numba and cached by content."""

from __future__ import annotations

import importlib.util
import inspect
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cosim.base.arrays import Array
from cosim.base.errors import Fault
from cosim.base.extras import optional
from cosim.kernel.buffers import ArrayKernel, constants
from cosim.kernel.generate import Generated
from cosim.kernel.kernel import Data
from cosim.storage.cache import cached
from cosim.storage.files import atomic_write


class JitKernel(ArrayKernel):
    """The filter through numba. Raises InputError where this Python has none."""

    def __init__(self, generated: Generated) -> None:
        self.layout = generated.layout
        self._module = _compiled(_source(generated))

    def _filter(self, data: Data, u: Array, y: Array, given: Sequence[Array], room: Sequence[Array]) -> int:
        times = (data.step, data.start, data.substeps, data.settle)
        return int(self._module.filter(*times, self._ramps(data), self._late(data), u, y, *given, *room))

    def _simulate(self, data: Data, u: Array, first: int, given: Sequence[Array], room: Sequence[Array]) -> None:
        self._module.simulate(data.step, data.start, data.substeps, self._ramps(data), u, first, *given, *room)


def _source(generated: Generated) -> str:
    """The whole Python module."""

    def literal(value: float | tuple[int, ...]) -> str:
        return f"np.array({list(value)}, np.intp)" if isinstance(value, tuple) else str(value)

    head = "\n".join(f"{name} = {literal(value)}" for name, value in constants(generated.layout).items())
    step, body = (Path(__file__).with_name(f"{name}.py").read_text(encoding="utf-8") for name in ("step", "filter"))
    later = body.replace("from __future__ import annotations\n", "")  # which stands at the top of a file only
    return f"{step}\n\n{later}\n\n{head}\n\n\n{generated.source}"


def _without_compiler(message: str) -> Fault:
    """Return the fault of a machine with neither a C compiler nor numba."""
    cure = 'install a C compiler ("CC" in the environment may name it)'
    return Fault(Path(sys.executable), 0, 0, f"{cure}; the filter without one {message}")


def _compiled(source: str) -> Any:
    """The module of a source, its functions compiled; numba keeps those of a signature in `__pycache__` beside it."""
    numba = optional("numba", _without_compiler)
    float64, intp = numba.float64, numba.intp

    module = _module(source)
    path = Path(module.__file__)
    options = {"nogil": True, "error_model": "numpy"}
    plain = {n: f for n, f in vars(module).items() if inspect.isfunction(f) and f.__module__ == module.__name__}
    for name, function in plain.items():
        setattr(module, name, numba.njit(function, **options))
    grid, v, M, flags = (float64, float64, intp), float64[::1], float64[:, ::1], numba.int32[::1]
    signatures = {
        "filter": intp(*grid, intp, flags, M, M, M, v, v, M, v, M, M, M, M, M),
        "simulate": intp(*grid, flags, M, intp, v, v, v, M, M, M, M),
    }
    for name, signature in signatures.items():
        try:
            compiled = numba.njit(signature, cache=True, **options)(plain[name])
        except Exception:  # whatever unpickling a damaged file may raise; a fault of the source raises again
            for file in (path.parent / "__pycache__").glob(f"{path.stem}.{name}-*.nb[ic]"):
                file.unlink()
            compiled = numba.njit(signature, cache=True, **options)(plain[name])
        setattr(module, name, compiled)
    return module


def _module(source: str) -> Any:
    """Import a source by a file of its own, which numba's cache asks for."""
    path = cached(source, ".py")
    if not path.exists() or path.read_bytes() != source.encode():
        with atomic_write(path) as stream:
            stream.write(source)
    spec = importlib.util.spec_from_file_location(f"cosim_kernel_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is no module")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where what numba has cached looks for it
    spec.loader.exec_module(module)
    return module
