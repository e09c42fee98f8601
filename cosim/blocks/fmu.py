"""An FMU as a component, loaded by FMPy and stepped without copies.

FMPy reads, checks, loads and instantiates the FMU; the loop then calls the library's functions directly. instance.py
contains the life cycle, values.py the transfer of values.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Collection, Mapping, MutableSequence, Sequence
from contextlib import suppress
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Self

from cosim.blocks.compiling import permission
from cosim.blocks.component import ADVANCE, in_turn
from cosim.blocks.instance import SIZE, Instance, end_of
from cosim.blocks.model_exchange import ModelExchange
from cosim.blocks.solvers import Solver
from cosim.blocks.stepping import Move, Slot, StopReason
from cosim.blocks.values import FmuVariables
from cosim.core.errors import FmuError
from cosim.fmi.annotations import AUTHOR, optional_inputs, sampled_by, traits_of
from cosim.fmi.description import Way, declares_slopes, slips_of, ways
from cosim.fmi.fmi_types import element_names
from cosim.fmi.state import Memory, Own, own_of, with_memory

POINTER = ctypes.c_void_p
SET_DERIVATIVES = ctypes.CFUNCTYPE(ctypes.c_int, POINTER, POINTER, SIZE, POINTER, POINTER)


class FmuBlock(FmuVariables):
    """An FMU instance as a component.

    Attributes:
        is_apart: True if the FMU runs in a process of its own.
        instance_class: Class of the instance; None for the class of the interface.
        clock_types: FMI types of clocks, which are known but neither set nor read like variables of other types.
        instance: Instance of the FMU, of the class for its interface.
        log: Messages of the FMU.

    Args:
        connected: Names of connected inputs; unconnected inputs keep their start values.
        way: Co-simulation or model exchange; None prefers co-simulation.
        tolerance: Relative tolerance of the solver; None for that of the FMU's default experiment.
        recorded: Names of further variables to record at every communication point.
        logging: Switch debug logging on.
        solver: Solver for model exchange.
        solver_step: Longest step of the solver [s]; None for 1/50 of the run.
        max_steps: Largest number of solver steps between communication points and events; None for the solver's
            default.
        feedthrough: Inputs with direct feedthrough to outputs without declared dependencies; None if unknown.
        compiles: Allow compilation of the sources if the library is missing; None for the current permission.
    """

    is_apart = False
    instance_class: type[Instance] | None = None
    clock_types: frozenset[str] = frozenset()
    _refuses = False  # True if the FMU fails to serialize its state although it declares this capability
    _arguments: tuple[Any, ...]
    _settings: dict[str, Any]

    def __new__(cls, *arguments: Any, **settings: Any) -> Self:
        block = super().__new__(cls)
        block._arguments, block._settings = arguments, settings  # for further instances
        return block

    def __init__(
        self,
        name: str,
        path: Path,
        description: Any,
        start: Mapping[str, Any],
        connected: frozenset[str],
        *,
        way: Way | None = None,
        tolerance: float | None = None,
        recorded: frozenset[str] = frozenset(),
        logging: bool = False,
        solver: Solver | None = None,
        solver_step: float | None = None,
        max_steps: int | None = None,
        feedthrough: frozenset[str] | None = None,
        compiles: bool | None = None,
    ) -> None:
        self.name, self.path, self.description = name, path, description
        self.start_values, self.connected, self.feedthrough = start, connected, feedthrough
        self.compiles = permission.get() if compiles is None else compiles
        way, kind = way or ways(description)[0], self.instance_class
        if kind is None:
            if way == "scheduled-execution":
                scenario = "components: {name: {fmu: FILE}}"
                raise FmuError(f"{path} uses scheduled execution; run it by a scenario ({scenario})")
            kind = Instance if way == "co-simulation" else ModelExchange
        self.instance = instance = kind(name, path, description, logging=logging, compiles=self.compiles)
        declared = getattr(description.defaultExperiment, "tolerance", None)
        instance.tolerance = tolerance if tolerance is not None else float(declared) if declared else None
        if isinstance(instance, ModelExchange):
            instance.solver_name, instance.longest, instance.max_steps = solver, solver_step, max_steps
        self.log = instance.log
        # With steps of equal length, repeating a run of a pythonfmu FMU gives the same bits.
        self.nominal_step = instance.by_pythonfmu
        self._choose_variables(recorded)

    def _choose_variables(self, recorded: frozenset[str]) -> None:
        names = self.connected | self.start_values.keys()
        free = {v.name for v in self.description.modelVariables if v.causality == "input"} - names
        # Only FMUs of cosim declare optional inputs.
        optional = optional_inputs(self.path) & free if free and self.description.author == AUTHOR else frozenset[str]()
        self.list_variables(self.connected, recorded, optional)

    def __reduce__(self) -> tuple[Callable[..., FmuBlock], tuple[Any, ...]]:
        """Return function and arguments from which another process creates this component."""
        return partial(type(self), **{**self._settings, "compiles": self.compiles}), self._arguments

    def with_start_values(self, start: Mapping[str, Any], unpacked: Path | None = None) -> FmuBlock:
        """Return another instance with other start values.

        Args:
            unpacked: Folder of the already unpacked FMU, left unchanged.
        """
        make, (name, path, description, _, connected) = self.__reduce__()
        block = make(name, path, description, start, connected)
        block.instance.place = unpacked
        return block

    # -- description ---------------------------------------------------------------

    def depends_on(self, name: str, outputs: Collection[str] | None = None) -> bool | None:
        stem = name.rpartition("[")[0]
        followers, undeclared = self._feedthrough_declared

        def is_any(variables: Sequence[Any]) -> bool:
            return any(
                outputs is None or v.name in outputs or not set(element_names(v)).isdisjoint(outputs) for v in variables
            )

        if is_any(followers.get(id(self.variables.get(name) or self.variables.get(stem)), ())):
            return True
        if not is_any(undeclared):
            return False
        is_stated = any(n in (name, stem) or n.rpartition("[")[0] == name for n in self.feedthrough or ())
        return True if is_stated else None

    @cached_property
    def _feedthrough_declared(self) -> tuple[dict[int, list[Any]], list[Any]]:
        """Return variable id → outputs that depend on the variable, and outputs without declared dependencies."""
        followers: dict[int, list[Any]] = {}
        for unknown in self.description.outputs:
            for variable in unknown.dependencies or ():
                followers.setdefault(id(variable), []).append(unknown.variable)
        return followers, [u.variable for u in self.description.outputs if u.dependencies is None]

    @cached_property
    def is_sampled(self) -> bool:
        """Return True for an FMU built by cosim that reads its inputs at sample times only, at the end of a step."""
        return self.description.author == AUTHOR and sampled_by(self.path) is not None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return warnings about the FMU before a run."""
        warnings = []
        if slips := slips_of(self.description):
            more = f" (and {len(slips) - 1} more)" if len(slips) > 1 else ""
            warnings.append(
                f"{self.path.name} breaks a rule of the FMI standard: {slips[0]}{more}; the FMU is used nevertheless"
            )
        if types := {v.type for v in self.description.modelVariables} - self.kinds.keys() - self.clock_types:
            warnings.append(
                f"variables of type {', '.join(sorted(types))} are not supported: they are neither set nor recorded"
            )
        return tuple(f"{self.name}: {warning}" for warning in warnings)

    # -- call sequence -----------------------------------------------------------------------------

    def open(self, start: float, stop: float) -> None:
        self.instance.time = start
        self.load()
        self.begin(start, stop)

    def open_again(self, values: Mapping[str, Any], start: float, stop: float) -> None:
        """Initialize a new instance with other start values; the library stays loaded."""
        self.start_values = values
        if self.instance.fmu is None:
            self.load()
        else:
            self.instance.renew()
            self.look_up()
        self.begin(start, stop)
        self.start()

    def load(self) -> None:
        """Load the FMU and instantiate it."""
        self.instance.load()
        self.look_up()

    def begin(self, start: float, stop: float) -> None:
        """Set start values and enter initialization mode at time `start` [s]."""
        instance, can_read = self.instance, self.instance.version > 1
        instance.time, instance.initialized = start, False
        instance.start_time, instance.stop_time = start, stop
        self.readable = can_read
        again = {}  # start values to set again: some FMUs (20-sim) forget those set before initialization
        for name, value in self.start_values.items() if can_read else ():
            v = self.variables.get(name)
            if v is None or v.causality == "structuralParameter":
                continue
            if v.causality == "input" or v.initial == "exact":
                again[name] = value
        with instance.check_calls():
            instance.prepare()
            self.set_variables(self.start_values)
            instance.enter()
            self.set_variables(again)
        self.show(self.inward, self.start_values, readable=can_read)
        self.watched = [] if self.changes_by_events and self.fed else None

    def start(self) -> None:
        with self.instance.check_calls():
            self.instance.leave()
        self.instance.initialized = True
        self.readable = True
        self._do_step = self.instance.stepping()

    def try_inputs(self) -> None:
        """Set the inputs without an event; in contrast, `put` causes one in model exchange."""
        if self.changes_by_events:
            self.put_all()
        else:
            self.put()

    @property
    def changes_by_events(self) -> bool:
        """Return True if a change of inputs is an event, as in model exchange."""
        return isinstance(self.instance, ModelExchange)

    def slopes(self, outputs: Sequence[str], inputs: Sequence[str]) -> list[list[float]] | None:
        """Return directional derivatives of outputs, one row per output; None if unavailable."""
        if not self._is_differentiable or not {*outputs, *inputs} <= self.variables.keys():
            return None  # Elements of arrays have no value reference of their own.
        variables = ([self.variables[name] for name in names] for names in (outputs, inputs))
        return [list(row) for row in zip(*self.instance.directional_derivatives(*variables), strict=True)]

    @cached_property
    def _is_differentiable(self) -> bool:
        return declares_slopes(self.path, self.instance.way)

    def nominal(self, name: str, default: float = 1.0) -> float:
        """Return the nominal value of a variable."""
        variable = self.variables.get(name) or self.variables.get(name.rpartition("[")[0])
        own = getattr(variable, "nominal", None) or getattr(getattr(variable, "declaredType", None), "nominal", None)
        return abs(float(own or default))

    def advance(self, t: float, h: float) -> None:
        instance = self.instance
        status = self._do_step(instance.component, t, h, 1)
        if status:
            instance.time = t
            instance.judge(instance.step_name, status)
        instance.time = t + h

    @property
    def interpolates_inputs(self) -> bool:
        """Return True if the FMU declares `canInterpolateInputs` (FMI 2.0, co-simulation)."""
        instance = self.instance
        return bool(instance.version == 2 and instance.way == "co-simulation" and instance.about.canInterpolateInputs)

    def step_by_derivatives(self, names: Sequence[str], orders: Sequence[Sequence[float]], t: float, h: float) -> None:
        """Set inputs and their derivatives (`orders`, first order first), advance by `h` [s], and get the outputs."""
        self.put()
        references, numbers, values = zip(
            *(
                (self.variables[name].valueReference, number, value)
                for number, derivatives in enumerate(orders, 1)
                for name, value in zip(names, derivatives, strict=True)
            ),
            strict=True,
        )
        count, name = len(references), "SetRealInputDerivatives"
        call = self.instance.bare(SET_DERIVATIVES, name)
        arrays = (ctypes.c_int * count)(*numbers), (ctypes.c_double * count)(*values)
        if status := call(self.instance.component, (ctypes.c_uint * count)(*references), count, *arrays):
            self.instance.judge(f"{self.instance.prefix}{name}", status)
        self.advance(t, h)
        self.get()

    def await_inputs(self, times: Collection[float] = (), *, always: bool = False) -> None:
        """In model exchange, handle an event at the end of a step together with the change of inputs there.

        Args:
            times: Ends of steps [s] at which `change` follows.
            always: True if inputs are set after every step.
        """
        if isinstance(self.instance, ModelExchange):
            self.instance.awaits_inputs, self.instance.changes_at = always, frozenset(times)

    def settle(self) -> None:
        """In model exchange, handle an event at the end of a step if inputs do not change there."""
        with self.instance.check_calls():
            self.instance.inputs_changed(None)

    def change(self, values: Mapping[str, Any]) -> None:
        """Set tunable parameters and inputs during a run."""
        with self.instance.check_calls():
            self.instance.inputs_changed(lambda: self.set_variables(values))
        self.show_changes(values)

    def close(self) -> None:
        self.instance.free()
        self.instance.remove()

    def stepping(self, doing: MutableSequence[int], first: int) -> Callable[[float, float], None]:
        return in_turn(self, doing, first, puts=bool(self.fed))

    # -- state --------------------------------------------------------------------------

    @property
    def rolls_back(self) -> bool:
        """Return True if steps can be repeated with other lengths.

        The FMU must save and restore its state and accept steps of any length.
        """
        about, any_step = self.instance.about, sampled_by(self.path) is None
        return bool(self._gives_state and about.canHandleVariableCommunicationStepSize and any_step)

    @property
    def saves(self) -> bool:
        return self._gives_state and self.instance.about.canSerializeFMUstate and not self._refuses

    @property
    def _gives_state(self) -> bool:
        """Return True for a co-simulation FMU that declares that its state can be saved and restored."""
        return bool(self.instance.way == "co-simulation" and self.instance.about.canGetAndSetFMUstate)

    def _call_of_state(self, verb: str, *arguments: Any) -> Any:
        """Call FMPy's method for the FMU state, such as `getFMUState` for `get`; a failure is a SimulationError."""
        is_fmi3 = self.instance.version == 3
        verb = "deSerialize" if verb == "deserialize" and not is_fmi3 else verb
        return self.instance.call(f"{verb}FMU{'State' if is_fmi3 else 'state'}", *arguments)

    def save_state(self) -> Any:
        """Save the FMU state and return its handle, which `restore_state` or `free_state` frees."""
        return self._call_of_state("get")

    def restore_state(self, state: Any, *, keep: bool = False) -> None:
        """Restore a saved state, and free it unless `keep` is True."""
        self._call_of_state("set", state)
        if not keep:
            self.free_state(state)

    def free_state(self, state: Any) -> None:
        """Free a saved state without restoring it."""
        self._call_of_state("free", state)

    def _serialize(self) -> bytes:
        """Return the FMU state as bytes; may raise any error of FMPy."""
        state = self._call_of_state("get")
        content = bytes(self._call_of_state("serialize", state))
        self._call_of_state("free", state)
        return content

    def checkpoint(self) -> dict[str, Any] | None:
        log = self.log.state()
        if not self.saves:
            return None
        try:
            content = self._serialize()
        except Exception:  # The run continues; a resumed run repeats all steps.
            self._refuses = True
            return None
        self.log.restore(log)  # Messages of these calls are not messages of the run.
        return {"state": content, "time": self.instance.time, "log": log}

    def restore(self, state: dict[str, Any]) -> None:
        self.restore_state(self._call_of_state("deserialize", state["state"]))
        self.instance.time = state["time"]
        self.log.restore(state["log"])

    # -- stepped by C -------------------------------------------------------------------------

    def slot(self, cells: Any) -> Slot | str:
        """Return the slot for the C loop, or the reason why the FMU cannot be stepped in C.

        Args:
            cells: Values beside the row.
        """
        instance = self.instance
        if self.nominal_step:
            return f"{self.name} is written in Python (pythonfmu)"
        if type(instance) is not Instance or instance.version == 1:
            return f"{self.name} uses FMI {self.description.fmiVersion} {instance.way}"
        if (moves := self.moves(cells)) is None:
            return f"{self.name} has binary values"
        (puts, gets), step = moves, instance.step_function()
        put, get = (Move * len(puts))(*puts), (Move * len(gets))(*gets)
        slot = Slot(instance.version, ctypes.cast(step, ctypes.c_void_p), instance.component, time=instance.time)
        slot.puts, slot.gets, slot.put, slot.get = len(put), len(get), ctypes.addressof(put), ctypes.addressof(get)
        slot.keeping = put, get
        return slot

    def set_time(self, t: float) -> None:
        """Record the time [s] after steps in C; raise an interruption that occurred meanwhile."""
        self.instance.time = t
        self.instance.raise_stop()

    def raise_error(self, reason: StopReason, slot: Slot) -> None:
        """Raise the error for which the C loop has returned.

        Warnings are only logged.

        Raises:
            SimulationError: A call or value is faulty.
            EarlyEnd: The FMU ended the simulation.
        """
        if reason == StopReason.TERMINATED:
            raise end_of(self.name, slot.reached)
        if slot.called == ADVANCE and reason not in (StopReason.NOT_FINITE, StopReason.UNFIT):
            self.instance.judge(self.instance.step_name, slot.status)
        else:
            self.raise_error_of_move(reason, slot)


class RestartableFmu(FmuBlock):
    """An FMU for repeated runs, which restarts without unpacking; access to the state of FMUs built by cosim."""

    def restart(self, values: Mapping[str, Any], start: float, stop: float) -> None:
        """Reset or reload the FMU, and enter initialization at `start` with new start values."""
        self.start_values = values
        is_reset = False
        if self.instance.fmu is not None and self._is_ours:  # some other FMUs (20-sim) do not move after a reset
            with suppress(Exception):  # FMPy raises bare Exceptions; if the reset fails, the FMU is loaded again.
                self.instance.fmu.reset()
                is_reset = True
        if not is_reset:
            self.instance.free()
            self.load()
        self.begin(start, stop)

    def own(self) -> Own:
        """Return time, state and memory, which determine the future.

        FMUs of other tools raise ValueError, KeyError or TypeError.
        """
        return own_of(self._serialize())

    def remember(self, memory: Memory) -> None:
        """Write memory into the state of an FMU built by cosim; start values can describe only a constant past."""
        self.restore_state(self._call_of_state("deserialize", with_memory(self._serialize(), memory)))

    @cached_property
    def _is_ours(self) -> bool:
        return traits_of(self.path) is not None
