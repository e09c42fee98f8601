"""Base class of FMI slaves in Python: variables, phases, checks and state.

Checks raise exceptions, because pythonfmu reports an exception as fmi2Fatal with the exception's text in the log. It
reports any other failure as fmi2Discard, which most hosts ignore.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partialmethod
from typing import Any, ClassVar

from pythonfmu import Boolean, Fmi2Slave, Real, String

from cosim.fmi.ports import Kind, Port, Value

INSTANTIATED, INITIALIZATION, STEP = "instantiated", "initialization", "step"
VARIABLE_CLASSES = {"Real": Real, "Boolean": Boolean, "String": String}


def tuples(value: Any) -> Any:
    """Return nested lists, which come from JSON, as nested tuples, which integrators need."""
    return tuple(map(tuples, value)) if isinstance(value, (list, tuple)) else value


@contextmanager
def loggable() -> Iterator[None]:
    """Re-raise errors with text that is safe for FMI's printf-like logger."""
    try:
        yield
    except Exception as error:
        raise RuntimeError(f"{type(error).__name__}: {error}".replace("%", "%%")) from error


class Slave(Fmi2Slave):  # type: ignore[misc]  # pythonfmu is untyped
    """An FMU in Python, whose variables are stored by value reference.

    Subclasses provide `ports` and four methods:

        initialize(values): Initialize from values set by the host, and write the outputs. Called after every change of
            a value by the host.
        advance(t, h): Step from `t` to `t + h` [s] with constant inputs, and write the outputs.
        snapshot(): Return the state, apart from the values of variables, as JSON types.
        restore(snapshot): Restore the state from a snapshot.
    """

    ports: ClassVar[tuple[Port, ...]]

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.modelName = type(self).__name__
        # contains a hash of the sources, by which states of another build are detected
        self.identity = f"{type(self).__module__}.{self.modelName}"
        self.values: list[Value] = [p.start for p in self.ports]
        self.host_values: set[int] = set()
        self.phase = INSTANTIATED
        self.current = False
        self.is_stale = False  # True if inputs have changed since the outputs were computed
        self.start_time = 0.0
        self.input_count = sum(p.causality == "input" for p in self.ports)
        self.output_slice = slice(self.input_count, self.input_count + sum(p.causality == "output" for p in self.ports))
        for port in self.ports:  # The model description is written from the ports.
            self.register_variable(VARIABLE_CLASSES[port.kind](port.name), nested=False)

    def follow_inputs(self) -> None:
        """Update the outputs that depend directly on inputs, without a step. An FMU with sample times does nothing."""

    @property
    def inputs(self) -> tuple[Any, ...]:
        """Return the inputs in order."""
        return tuple(self.values[: self.input_count])

    def set_outputs(self, outputs: tuple[float, ...] | list[float]) -> None:
        """Set the outputs; raise ArithmeticError for a value that is not finite."""
        if not math.isfinite(sum(outputs)):
            for port, value in zip(self.ports[self.output_slice], outputs, strict=True):
                if not math.isfinite(value):
                    raise ArithmeticError(f"{port.name} is {value}")
        self.values[self.output_slice] = outputs

    # -- FMI ----------------------------------------------------------------------------------

    def setup_experiment(self, start_time: float, stop_time: float | None, tolerance: float | None) -> None:
        self.start_time = start_time

    def enter_initialization_mode(self) -> None:
        self.phase, self.current = INITIALIZATION, False

    def exit_initialization_mode(self) -> None:
        self._refresh()
        self.phase = STEP

    def do_step(self, current_time: float, step_size: float) -> bool:
        if self.phase is not STEP:
            raise RuntimeError(f"doStep was called in phase {self.phase}; end initialization first")
        if not (0.0 < step_size < math.inf and math.isfinite(current_time)):
            raise ValueError(f"step of {step_size} s at t = {current_time} s; it must be positive and finite")
        with loggable():
            try:
                self.advance(current_time, step_size)
            except Exception:
                self.log_queue.clear()  # While messages are queued, pythonfmu drops the exception's text.
                raise
        self.is_stale = False
        return True

    def log(self, msg: str, *arguments: Any, **options: Any) -> None:
        super().log(msg.replace("%", "%%"), *arguments, **options)

    def get_real(self, vrs: list[int]) -> list[Any]:
        if self.phase is INITIALIZATION:
            self._refresh()
        elif self.is_stale:
            self.is_stale = False
            with loggable():
                self.follow_inputs()
        if max(vrs, default=0) >= self.output_slice.stop:
            self._check_kind(vrs, "Real")
        values = self.values
        return [values[vr] for vr in vrs]

    def _get(self, kind: Kind, vrs: list[int]) -> list[Any]:
        self._check_kind(vrs, kind)
        return [self.values[vr] for vr in vrs]

    get_boolean, get_string = partialmethod(_get, "Boolean"), partialmethod(_get, "String")

    def set_real(self, vrs: list[int], values: list[float]) -> None:
        for vr, value in zip(vrs, values):  # noqa: B905 - hot loop
            if value - value != 0.0:
                raise ValueError(f"{self.ports[vr].name} is set to {value}; use a finite number")
            if vr >= self.input_count:
                self._check_settable(vr, "Real")
            self.values[vr] = value
        if self.phase is STEP:
            self.is_stale = True
        else:
            self.host_values.update(vrs)
            self.current = False

    def _set_parameters(self, kind: Kind, vrs: list[int], values: Sequence[Value]) -> None:
        for vr, value in zip(vrs, values, strict=True):
            self._check_settable(vr, kind)
            self.values[vr] = value
        self.host_values.update(vrs)
        self.current = False

    set_boolean, set_string = partialmethod(_set_parameters, "Boolean"), partialmethod(_set_parameters, "String")

    def _get_fmu_state(self) -> dict[str, Any]:
        return {
            "model": self.identity,
            "phase": self.phase,
            "start_time": self.start_time,
            "values": list(self.values),
            "given": sorted(self.host_values),
            "current": self.current,
            "is_stale": self.is_stale,
            "own": self.snapshot() if self.phase is STEP else None,
        }

    def _set_fmu_state(self, state: dict[str, Any]) -> None:
        if state.get("model") != self.identity:
            raise ValueError("this FMU state belongs to another FMU")
        # Checks compare the phases by `is`.
        self.phase = next(p for p in (INSTANTIATED, INITIALIZATION, STEP) if p == state["phase"])
        self.start_time, self.host_values = state["start_time"], set(state["given"])
        self.current = state["current"] and self.phase is STEP
        self.is_stale = bool(state.get("is_stale"))
        if self.phase is STEP:
            self.values = list(state["values"])
            self._initialize()
            self.restore(state["own"])
        self.values = list(state["values"])

    @staticmethod
    def _fmu_state_to_bytes(state: dict[str, Any]) -> bytes:
        return json.dumps(state).encode()

    # -- internal -------------------------------------------------------------------------------

    def _initialize(self) -> None:
        self.initialize({self.ports[vr].name: self.values[vr] for vr in self.host_values})

    def _refresh(self) -> None:
        if not self.current:
            with loggable():
                self._initialize()
            self.current = True

    def _check_kind(self, vrs: list[int], kind: Kind) -> None:
        for vr in vrs:
            if self.ports[vr].kind != kind:
                raise TypeError(f"{self.ports[vr].name} is {self.ports[vr].kind}, not {kind}")

    def _check_settable(self, vr: int, kind: Kind) -> None:
        self._check_kind([vr], kind)
        port = self.ports[vr]
        if port.causality == "output":
            raise ValueError(f"{port.name} is an output")
        if self.phase is STEP and port.causality == "parameter":
            raise ValueError(f"{port.name} is a fixed parameter; set it before the end of initialization")
