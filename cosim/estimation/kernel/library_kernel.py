"""Filters in C: of a model, compiled for its measured outputs; and of an FMU, with its library, in a worker process."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from cosim.blocks.derivatives import DifferentiableFmu
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.shared_code import claim
from cosim.core.arrays import Array, NamedValues
from cosim.core.linear_algebra import least_squares
from cosim.estimation.kernel.generate import LOCAL, NATIVE, SHAPE_PREFIX, Generated
from cosim.estimation.kernel.kernel import CORRELATION_TIME, Data, Filtered, Simulated, no_filtered, no_simulated
from cosim.fmi.description import reals, takes_any_step
from cosim.fmi.native.compiler import load_library
from cosim.isolation.limits import Limits
from cosim.probing.fmu_structure import START_STEP
from cosim.terms.language import Direction


class _Log(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int) for name in ("rows", "substeps", "settle")),
        *((name, ctypes.c_double) for name in ("step", "start")),
        *((name, ctypes.c_void_p) for name in ("u", "y", "ramps", "late", "lags")),
    )
    arrays: list[Array]  # arrays whose addresses the structure contains


class CompiledKernel:
    """A kernel in C. An array without rows means that there is no such array.

    Raises:
        NoCompiler: There is no C compiler.
        CompilerFailed: The compiler reports an error.
    """

    def __init__(self, generated: Generated) -> None:
        self.layout, source = generated
        self._library = load_library(source, NATIVE / "rk4.h", NATIVE / "stiff.h")

    def run(self, data: Data, p: Array, x0: Array, P0: Array, q: Array, r: Array, *, states: bool = False) -> Filtered:
        """Filter one log, as `Kernel.run`."""
        made = no_filtered(self.layout, data, states=states)
        inputs = [_contiguous(v) for v in (p, x0, P0, q, np.broadcast_to(r, data.y.shape))]
        log, addresses = self._log(data, data.y, data.late, data.lags), map(_address, (*inputs, *vars(made).values()))
        done = self._library.filter(ctypes.byref(log), *addresses)
        made.errors[done:], made.variances[done:] = np.inf, 1.0
        return made

    def simulate(
        self, data: Data, p: Array, x0: Array, memory: Array, kicks: Array | None = None, first: int = 0
    ) -> Simulated:
        """Simulate with the commands of a log, as `Kernel.simulate`."""
        self._use(p, data, x0)
        made = no_simulated(self.layout, data)
        inputs = [_contiguous(v) for v in (p, x0, memory, np.empty(0) if kicks is None else kicks)]
        log, addresses = self._log(data), map(_address, (*inputs, *vars(made).values()))
        self._library.simulate(ctypes.byref(log), first, *addresses)
        return made

    def simulate_from(
        self, data: Data, p: Array, points: tuple[Sequence[int], Any, Any], length: int
    ) -> list[Simulated]:
        """Simulate a log from each of some rows, as `Problem.simulate_from`."""
        rows, states, memory = np.array(points[0], np.int32), _contiguous(points[1]), _contiguous(points[2])
        sizes = len(self.layout.outputs), len(self.layout.states), self.layout.memory
        made = [np.full((len(rows), length + 1, size), np.nan) for size in sizes]
        if len(rows):
            self._use(p, data, states[0])
        p = _contiguous(p)
        addresses = map(_address, (p, states, memory, *made))
        self._library.simulate_from(ctypes.byref(self._log(data)), len(rows), _address(rows), length, *addresses)
        ends = np.minimum(length + 1, len(data.u) - rows).tolist()
        return [Simulated(*(each[:end] for each in run)) for end, *run in zip(ends, *made, strict=True)]

    def _use(self, p: Array, data: Data, x0: Array) -> None:
        """Prepare the functions of the model; a derived class prepares those of a library."""

    def _log(self, data: Data, y: Array | None = None, late: Array | None = None, lags: Array | None = None) -> _Log:
        """Return a log as a C structure, by default without readings; the structure references its arrays."""
        u, *past = (_contiguous(np.empty(0) if a is None else a) for a in (data.u, y, late, lags))
        ramps: Any = np.array([name in data.interpolated for name in self.layout.inputs], np.int32)
        arrays = [u, past[0], ramps, *past[1:]]
        times = len(data.u), data.substeps, data.settle, data.step, data.start
        log = _Log(*times, *map(_address, arrays))
        log.arrays = arrays
        return log


def _contiguous(a: Array) -> Array:
    """Return an array as contiguous doubles, as C requires."""
    return np.require(a, np.float64, ["C"])


def _address(a: Any) -> ctypes.c_void_p:
    return ctypes.c_void_p(a.ctypes.data if a.size else None)


MODEL_COMPONENT = "model"  # component name in messages
MAX_CACHED_RUNS = 32  # free runs and responses
HIDDEN, EXACT = 1.5, 1e-6  # fall of ln squared errors from which a state is hidden; share of the squared change
STATE_STEP = 1e-6  # step of differences, as a share of a state's usual size

FMU_FUNCTIONS = ("set_time", "set_states", "get_rates", "complete", "step", "set_reals", "get_reals")


class _Library(ctypes.Structure):
    """Functions and variables of an FMU instance, as the structure in `library_calls.c`."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("instance", *FMU_FUNCTIONS, "inputs", "outputs", "steps")),
        ("version", ctypes.c_int),
        ("directions", ctypes.c_int),
        *((name, ctypes.c_void_p) for name in ("second", "braked", "speeds", "changes")),
    )


NO_LIMITS = Limits()


class LibraryOf(NamedTuple):
    """An FMU whose library a kernel calls.

    Attributes:
        variables: Parameter of the kernel → variable of the FMU; other parameters are ignored.
        sizes: Usual size of each state, for differences.
        starts: Co-simulation: variable of each start state → its usual size.
        values: Parameter values at which the effect of start states on the outputs is computed.
        limits: Limits of a pass over a log; `step` limits its duration.
        directions: Directions of forces, which need a second instance.
        neutral: Parameters of the terms that act along directions, with their neutral values.
    """

    path: Path
    description: Any
    variables: Mapping[str, str]
    sizes: Sequence[float]
    starts: tuple[tuple[str, float], ...] = ()
    values: NamedValues = MappingProxyType({})
    limits: Limits = NO_LIMITS
    directions: tuple[Direction, ...] = ()
    neutral: NamedValues = MappingProxyType({})


class LibraryInstance:
    """An FMU instance in continuous-time mode, which is initialized again whenever a parameter changes."""

    def __init__(self, fmu: LibraryOf, *, stepped: bool = False) -> None:
        self._path, self._description, self._stepped = fmu.path, fmu.description, stepped
        self._steps = np.array([STATE_STEP * (size or 1.0) for size in fmu.sizes])
        self._values: dict[str, float] | None = None
        self._block: FmuBlock | None = None
        self._functions_of = _Library()

    def prepare(self, values: NamedValues, start: float = 0.0, stop: float = 1.0) -> _Library:
        """Return the functions of an instance with these parameter values; for co-simulation, at its start time.

        Raises:
            SimulationError: The FMU refuses the values.
        """
        if self._values == values and not self._stepped:
            return self._functions_of
        self._values = None
        if self._block is None:
            kind: Any = partial(FmuBlock, way="co-simulation") if self._stepped else DifferentiableFmu
            self._block = kind(MODEL_COMPONENT, self._path, self._description, {}, frozenset())
            self._block.bind_nothing()
        self._block.open_again(values, start, stop)
        self._values, self._functions_of = dict(values), self._functions(self._block)
        return self._functions_of

    def _functions(self, block: FmuBlock) -> _Library:
        """Return the functions of the library, for C."""
        fmu, version = block.instance.fmu, int(self._description.fmiVersion[0])
        kind, state = ("Real", "") if version == 2 else ("Float64", "ContinuousState")
        names = {"set_reals": f"Set{kind}", "get_reals": f"Get{kind}"}
        if self._stepped:
            names["step"] = "DoStep"
        else:
            names |= {"set_time": "SetTime", "set_states": "SetContinuousStates", "get_rates": f"Get{state}Derivatives"}
            if self._description.modelExchange.needsCompletedIntegratorStep:
                names["complete"] = "CompletedIntegratorStep"
        functions = {n: ctypes.cast(getattr(fmu.dll, f"fmi{version}{s}"), ctypes.c_void_p) for n, s in names.items()}
        groups = [[v.valueReference for v in reals(self._description, kind)] for kind in ("input", "output")]
        self._references = [np.array(group or [0], np.uint32) for group in groups]
        addresses = [a.ctypes.data for a in (*self._references, self._steps)]
        variables = dict(zip(("inputs", "outputs", "steps"), addresses, strict=True))
        return _Library(instance=fmu.component, version=version, **functions, **variables)


class LibraryKernel(CompiledKernel):
    """Kernel of an FMU with added terms."""

    def __init__(self, generated: Generated, fmu: LibraryOf) -> None:
        claim(fmu.path)
        super().__init__(generated)
        self._fmu, self._stepped, order = fmu, self.layout.is_free_run, self.layout.parameters
        self._instance, self._second = LibraryInstance(fmu, stepped=self._stepped), LibraryInstance(fmu)
        self._places = {v: order.index(n) for n, v in fmu.variables.items() if n in order}
        self._turned = {order.index(n): v for n, v in fmu.neutral.items() if n in order}
        self._along = {order.index(n): v for n, v in self.layout.along.items() if self.layout.positions}
        shapes = f"{SHAPE_PREFIX}.", f"{LOCAL}."
        self._not_of_run = [k for k, n in enumerate(order) if n == CORRELATION_TIME or n.startswith(shapes)]
        self._last: dict[tuple[Any, ...], Any] = {}  # free runs and responses

    def run(self, data: Data, p: Array, x0: Array, P0: Array, q: Array, r: Array, *, states: bool = False) -> Filtered:
        """Filter one log, as `Kernel.run`."""
        if not self._stepped:
            self._use(p, data, x0)
            return super().run(data, p, x0, P0, q, r, states=states)
        follows = any(p[k] != neutral for k, neutral in self._along.items())
        if follows and not _asks_past(data):  # then the filter itself makes the free run
            counts = len(self.layout.outputs), len(self.layout.states), self.layout.memory
            run = Simulated(*(np.zeros((len(data.u), count)) for count in counts))
        else:
            run = self._free_run(data, p, x0)
        own = run.outputs, self._bends(data, p, x0, run.outputs), run.states, run.memory
        arrays = [np.array(a, np.float64, order="C") for a in (*own, *self.responses(data, x0))]
        if follows:
            self._use(p, data, x0)
        self._library.use_run(*(a.ctypes.data_as(ctypes.c_void_p) for a in arrays), int(follows))
        return super().run(data, p, x0, P0, q, r, states=states)

    def call(self, method: str, passes: Sequence[Any], options: Mapping[str, Any]) -> tuple[list[Any], float]:
        """Call a method with the arguments of each pass; return the results and the processor time [s]."""
        begin = time.process_time()
        return [getattr(self, method)(*each, **options) for each in passes], time.process_time() - begin

    def _free_run(self, data: Data, p: Array, x0: Array) -> Simulated:
        """Return the free run at parameter values, cached, since fits often change only noise levels."""
        acting = p.copy()
        acting[self._not_of_run] = 0.0
        run: Simulated = self._cached(
            (acting, x0), data, lambda: self.simulate(data, p, x0, np.zeros(self.layout.memory))
        )
        return run

    def _cached(self, numbers: Sequence[Array], data: Data, make: Callable[[], Any]) -> Any:
        """Return the result of `make`, cached by `numbers` and the inputs of a log; only the last results are kept."""
        key = data.u.tobytes(), data.interpolated, data.start, data.step, data.substeps, *(n.tobytes() for n in numbers)
        made = self._last[key] = self._last.pop(key) if key in self._last else make()
        for oldest in [*self._last][:-MAX_CACHED_RUNS]:
            del self._last[oldest]
        return made

    def _bends(self, data: Data, p: Array, x0: Array, outputs: Array) -> Array:
        """Return how far outputs are from a straight line halfway to each row; 0 if no reading is late.

        The result is also 0 for an odd number of substeps of an FMU that does not accept steps of any length.
        """
        bends, substeps = np.zeros_like(outputs), data.substeps
        if not _asks_past(data) or (substeps % 2 and not takes_any_step(self._fmu.description)):
            return bends
        u = np.repeat(data.u, 2, axis=0)[:-1]
        ramps = np.array([name in data.interpolated for name in self.layout.inputs], bool)
        u[1::2, ramps] = 0.5 * (data.u[:-1, ramps] + data.u[1:, ramps])
        half = replace(data, u=u, step=0.5 * data.step, substeps=max(1, substeps // 2), late=None, lags=None)
        between = self._free_run(half, p, x0).outputs[1::2]
        bends[1:] = between - 0.5 * (outputs[:-1] + outputs[1:])
        return np.asarray(np.nan_to_num(bends, posinf=0.0, neginf=0.0))

    def responses(self, data: Data, x0: Array) -> tuple[Array, Array]:
        """Return the outputs' derivatives by start states (rows, outputs, start states), and the propagation.

        Both are computed at the parameter values of `LibraryOf`, because they change little with the parameters.
        Without start states, the propagation is computed from pulses of the inputs in the first row.
        """
        p = np.array([self._fmu.values.get(name, 0.0) for name in self.layout.parameters])

        def outputs(data: Data, x0: Array) -> Array:
            return self.simulate(data, p, x0, np.zeros(self.layout.memory)).outputs

        def respond() -> tuple[Array, Array]:
            plain, slopes, pulses = outputs(data, x0), list[Array](), list[Array]()
            for place, (_, size) in enumerate(self._fmu.starts, len(x0) - len(self._fmu.starts)):
                moved = x0.copy()
                moved[place] += START_STEP * size
                slopes.append((outputs(data, moved) - plain) / (moved[place] - x0[place]))
            for k in () if slopes else np.flatnonzero(np.ptp(data.u, axis=0)):
                u = data.u.copy()
                u[0, k] += START_STEP * np.ptp(u[:, k])
                pulses.append((outputs(replace(data, u=u), x0) - plain)[1:])
            of_starts, told = (
                np.nan_to_num(np.stack(each, axis=2), posinf=0.0, neginf=0.0) if each else np.zeros((*plain.shape, 0))
                for each in (slopes, slopes or pulses)
            )
            return of_starts, propagation(told)

        found: tuple[Array, Array] = self._cached((x0,), data, respond)
        return found

    def _use(self, p: Array, data: Data, x0: Array) -> None:
        """Prepare the FMU instance with parameter and start values."""
        values = {name: float(p[k]) for name, k in self._places.items()}
        values |= zip(
            (name for name, _ in self._fmu.starts), x0[len(x0) - len(self._fmu.starts) :].tolist(), strict=True
        )
        times = data.start, data.start + len(data.u) * data.step
        prepared = self._instance.prepare(values, *times)
        if any(p[k] != neutral for k, neutral in self._turned.items()):
            # a second instance has other damping values, for the directions
            directions, prepared = self._fmu.directions, _Library.from_buffer_copy(prepared)
            other = {d.parameter: d.changed(values[d.parameter]) for d in directions}
            second = self._second.prepare({**values, **other}, *times)
            arrays = {
                "braked": np.array([d.state for d in directions], np.int32),
                "speeds": np.array([d.speed for d in directions]),
                "changes": np.array([other[d.parameter] - values[d.parameter] for d in directions]),
            }
            prepared.second, prepared.directions = ctypes.addressof(second), len(directions)
            for name, array in arrays.items():
                setattr(prepared, name, array.ctypes.data)
            self._kept = prepared, second, arrays  # C uses their addresses
        self._library.use_library(ctypes.byref(prepared))


def _asks_past(data: Data) -> bool:
    """Return True if readings depend on outputs before their row."""
    return data.lags is not None or bool(data.late is not None and np.any(data.late))


def propagation(responses: Array) -> Array:
    """Return [Φ Ψ] of δ⁺ = Φ·δ + Ψ·δ⁻, where δ are deviations of a free run's outputs, and δ⁻ those one row before.

    All small deviations have the same dynamics, of which Φ and Ψ are least-squares estimates. If the previous row of an
    output shows a hidden state, e.g. the velocity of a position, its column in Ψ is not zero. Growing dynamics are
    scaled to be constant. Without responses, Φ and Ψ are 0.

    Args:
        responses: Deviations of the outputs (rows, outputs, responses).
    """
    _, outputs, count = responses.shape
    whole = np.zeros((outputs, 2 * outputs))
    if not count:
        return whole
    size = np.sqrt(np.mean(responses**2, axis=(0, 2)))
    size[size == 0.0] = 1.0
    scaled = responses / size[:, None]
    scaled = scaled / np.maximum(np.sqrt(np.sum(scaled**2, axis=(0, 1))), np.finfo(float).tiny)
    parts = scaled.transpose(0, 2, 1)
    chosen, matrix = _with_hidden_states(*(part.reshape(-1, outputs) for part in (parts[1:-1], parts[:-2], parts[2:])))
    whole[:, [*range(outputs), *(outputs + j for j in chosen)]] = matrix
    growth = max(1.0, float(np.abs(np.linalg.eigvals(np.vstack([whole, np.eye(outputs, 2 * outputs)]))).max()))
    return np.asarray(whole / np.repeat([growth, growth**2], outputs) * size[:, None] / np.tile(size, 2))


def _with_hidden_states(now: Array, before: Array, after: Array) -> tuple[list[int], Array]:
    """Return the outputs whose previous row shows a hidden state, and the matrix from `now` and these rows to `after`.

    Outputs are added one by one as long as the prediction of the next row improves clearly. Among equally good outputs,
    the one with the worst prediction so far is added.
    """
    change = np.sum((after - now) ** 2, axis=0)
    change[change == 0.0] = 1.0

    def regression(chosen: list[int]) -> tuple[Array, Array]:
        known = np.hstack([now, before[:, chosen]])
        matrix = least_squares(known, after, rcond=float(np.sqrt(np.finfo(float).eps)))
        left = np.sum((after - known @ matrix) ** 2, axis=0) / change
        return matrix.T, np.log(np.maximum(left, EXACT))

    chosen: list[int] = []
    matrix, left = regression(chosen)
    while rest := [j for j in range(now.shape[1]) if j not in chosen]:
        trials = {j: regression([*chosen, j]) for j in rest}
        best = min(rest, key=lambda j: (float(trials[j][1].sum()), -left[j]))
        if left.sum() - trials[best][1].sum() < HIDDEN:
            break
        chosen.append(best)
        matrix, left = trials[best]
    return chosen, matrix
