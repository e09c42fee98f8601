"""Equations of a model generated as C for many runs at once, and compiled."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import cosim.fmi.native
from cosim.base.arrays import Array
from cosim.fmi.native.compiler import CompilerFailed, compiler, load_library
from cosim.model.integrate import substeps
from cosim.model.symbolic.functions import Body
from cosim.model.symbolic.languages import Lanes, Unprintable
from cosim.storage.cache import fingerprint, load_or_make

WIDTH = 16  # runs per block; numbers of runs are padded to multiples
SOURCE = Path(__file__).with_name("lanes.c")
RK4 = Path(cosim.fmi.native.__file__).with_name("rk4.h")
PRINTING = ("cosim.model.symbolic", "cosim.model")


class Stepping:
    """A model bound to compiled equations, with parameter values for each of `runs`."""

    def __init__(self, function: Any, model: Any, parameters: tuple[str, ...], runs: int) -> None:
        self._function, self._longest, self._runs = function, model.substep, runs
        values = _values(model)
        self._parameters = np.empty((len(parameters), runs))
        for row, name in zip(self._parameters, parameters, strict=True):
            row[:] = values[name]

    def substeps(self, h: float) -> int:
        """Return the number of substeps in a communication step [s]."""
        return substeps(h, self._longest)

    def step(self, t: float, dt: float, count: int, state: Array, command: Array, outputs: Array | None) -> None:
        """Make `count` substeps of `dt` [s] from `t`.

        Args:
            outputs: Receives the outputs at the end, unless None.
        """
        end = t + count * dt
        arrays = (state, command, self._parameters, outputs)
        addresses = (None if a is None else a.ctypes.data for a in arrays)
        self._function(self._runs, t, dt, count, end, *addresses)

    def output(self, t: float, state: Array, command: Array, outputs: Array) -> None:
        """Compute the outputs without a step."""
        self.step(t, 0.0, 0, state, command, outputs)


def stepping(model: Any, runs: int) -> Stepping | None:
    """Return the compiled model, if compilation is possible."""
    if compiler() is None or runs % WIDTH or not model.base_states:
        return None
    awake = tuple(effect.name for effect in model.awake)
    flags = tuple(sorted((p.name, getattr(model, p.name)) for p in model.parameters if isinstance(p.default, bool)))
    made = _function(type(model), model if flags else type(model)(), awake, flags)
    return None if made is None else Stepping(made[0], model, made[1], runs)


def _values(model: Any) -> dict[str, Any]:
    """Return all parameters of the base model and active effects."""
    found = {p.name: getattr(model, p.name) for p in model.parameters}
    for effect in model.awake:
        found |= {name: getattr(effect, name.partition(".")[2]) for name in _of(effect, model)}
    return found


def _of(effect: Any, model: Any) -> list[str]:
    return [name for name in model.declared if name.startswith(f"{effect.name}.")]


@cache
def _compiled(source: str) -> Any:
    library = load_library(source, RK4)
    function = library.steps
    number, address = ctypes.c_double, ctypes.c_void_p
    function.argtypes = [ctypes.c_long, number, number, ctypes.c_int, number, address, address, address, address]
    function.restype = None
    return function


_FUNCTIONS: dict[Any, tuple[Any, tuple[str, ...]] | None] = {}


def _function(
    kind: type, model: Any, awake: tuple[str, ...], flags: tuple[tuple[str, bool], ...]
) -> tuple[Any, tuple[str, ...]] | None:
    """Return the compiled function and its parameter names."""
    key = kind, awake, flags
    if key not in _FUNCTIONS:
        try:
            source, names = _printed(model, awake, dict(flags))
            _FUNCTIONS[key] = _compiled(source), tuple(names)
        except (Unprintable, CompilerFailed, TypeError, AttributeError):
            _FUNCTIONS[key] = None
    return _FUNCTIONS[key]


def _printed(model: Any, awake: tuple[str, ...], flags: dict[str, bool]) -> tuple[str, list[str]]:
    body = Body.of(model, effects=awake, flags=flags)
    names = list(body.parameters)
    derivative, outputs = list(body.derivative.values()), list(body.outputs.values())
    content = repr((fingerprint(PRINTING), [str(e) for e in (*derivative, *outputs)], names))

    def make() -> str:
        language = Lanes()
        functions = "\n".join(
            body.function(language, name, of) for name, of in (("deriv", derivative), ("measure", outputs))
        )
        sizes = {
            "W": WIDTH,
            "NX": len(derivative),
            "NU": len(body.symbols.command),
            "NY": len(outputs),
            "NP": len(names),
        }
        defined = "".join(f"#define {name} {size}\n" for name, size in sizes.items())
        return defined + SOURCE.read_text(encoding="utf-8").replace("/*LANES*/", functions)

    return load_or_make(content + SOURCE.read_text(encoding="utf-8"), make), names
