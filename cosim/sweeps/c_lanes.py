"""Equations of a model generated as C for many runs at once, and compiled."""

from __future__ import annotations

import ctypes
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


def compile_model(model: Any, runs: int) -> Stepping | None:
    """Return the compiled model, if compilation is possible."""
    if compiler() is None or runs % WIDTH or not model.base_states:
        return None
    awake = tuple(effect.name for effect in model.awake)
    flags = tuple(sorted((p.name, getattr(model, p.name)) for p in model.parameters if isinstance(p.default, bool)))
    function = _function(type(model), model if flags else type(model)(), awake, flags)
    return None if function is None else Stepping(function[0], model, function[1], runs)


def _values(model: Any) -> dict[str, Any]:
    """Return all parameters of the base model and active effects."""
    owners = {effect.name: effect for effect in model.awake}
    values = {p.name: getattr(model, p.name) for p in model.parameters}
    for name in model.declared:
        owner, _, parameter = name.partition(".")
        if owner in owners:
            values[name] = getattr(owners[owner], parameter)
    return values


_FUNCTIONS: dict[Any, tuple[Any, tuple[str, ...]] | None] = {}


def _function(
    kind: type, model: Any, awake: tuple[str, ...], flags: tuple[tuple[str, bool], ...]
) -> tuple[Any, tuple[str, ...]] | None:
    """Return the compiled function and its parameter names."""
    key = kind, awake, flags
    if key not in _FUNCTIONS:
        try:
            source, names = _print_source(model, awake, dict(flags))
            function = load_library(source, RK4).steps
        except (Unprintable, CompilerFailed, TypeError, AttributeError):
            _FUNCTIONS[key] = None
        else:
            number, address = ctypes.c_double, ctypes.c_void_p
            function.argtypes = [ctypes.c_long, number, number, ctypes.c_int, number, *4 * [address]]
            function.restype = None
            _FUNCTIONS[key] = function, tuple(names)
    return _FUNCTIONS[key]


def _print_source(model: Any, awake: tuple[str, ...], flags: dict[str, bool]) -> tuple[str, list[str]]:
    body = Body.of(model, effects=awake, flags=flags)
    names = list(body.parameters)
    derivative, outputs = list(body.derivative.values()), list(body.outputs.values())
    content = repr((fingerprint(PRINTING), [str(e) for e in (*derivative, *outputs)], names))
    frame = SOURCE.read_text(encoding="utf-8")

    def make() -> str:
        functions = (("deriv", derivative), ("measure", outputs))
        language = Lanes()
        code = "\n".join(body.function(language, name, expressions) for name, expressions in functions)
        sizes = {"NX": len(derivative), "NU": len(body.symbols.command), "NY": len(outputs), "NP": len(names)}
        defines = "".join(f"#define {name} {size}\n" for name, size in {"W": WIDTH, **sizes}.items())
        return defines + frame.replace("/*LANES*/", code)

    return load_or_make(content + frame, make), names
