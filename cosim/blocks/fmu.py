"""An FMU, loaded by FMPy and stepped without copies.

FMPy reads, checks, loads and instantiates; in the loop its wrappers give way to the bare functions of
the library. Reals are moved between the FMU and the row as they are, all other types by way of a buffer.
"""

from __future__ import annotations

import ctypes
import math
import os
import shutil
import tempfile
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, MutableSequence, Sequence
from contextlib import contextmanager
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from cosim.blocks.description import (
    Way,
    default_tolerance,
    library_of,
    named,
    offer_libm,
    read_description,
    slips_of,
    unit_definition,
    unit_of,
    ways,
)
from cosim.blocks.fmi import AtOnce, Calls, CoSimulation1, CoSimulation2, CoSimulation3, Step, ended
from cosim.blocks.guard import without_wrapping
from cosim.blocks.interface import ADVANCE, GET, PUT, EndedEarly, Row, in_turn
from cosim.blocks.kinds import Exchange, element_names
from cosim.blocks.model_exchange import ModelExchange2, ModelExchange3
from cosim.blocks.ports import Ports
from cosim.blocks.solvers import Solver
from cosim.blocks.stepping import Plan, Slot, Why, fmu_slot, move
from cosim.errors import DiskFull, FmuError, SimulationError, Terminated
from fmus.archive import unpack
from fmus.files import is_full
from fmus.lifetime import let_go_at_exit
from fmus.sampled import AUTHOR, optional_inputs, sampled_by

__all__ = ["FmuBlock", "named", "read_description", "unit_definition", "unit_of"]

STATUS = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")
WARNING, DISCARD, FATAL = 1, 2, 4
KEPT_MESSAGES, LONGEST_MESSAGE = 50, 1000  # of a talkative FMU, the last ones; characters
FOUND: dict[tuple[str, Way], type[Calls]] = {
    ("1", "co-simulation"): CoSimulation1,
    ("2", "co-simulation"): CoSimulation2,
    ("3", "co-simulation"): CoSimulation3,
    ("2", "model-exchange"): ModelExchange2,
    ("3", "model-exchange"): ModelExchange3,
}


class FmuBlock:
    """One FMU instance.

    connected: names of the inputs that are fed; the others keep their start values
    way:       co-simulation or model exchange; None takes what the FMU offers, co-simulation first
    tolerance: relative, for its solver; None takes that of its default experiment
    recorded:  names of further variables that are read at every communication point
    logging:   its debug messages are asked for
    solver:    of model exchange
    """

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
    ) -> None:
        self.name, self.path, self.description = name, path, description
        self.start_values, self.connected = start, connected
        self._made_of = (
            partial(
                type(self),
                way=way,
                tolerance=tolerance,
                recorded=recorded,
                logging=logging,
                solver=solver,
            ),
            (name, path, description, start, connected),
        )
        # of ours, and others by pythonfmu: a replay of a run takes the same steps, and repeats it bit for bit
        self.nominal_step = "pythonfmu" in (description.generationTool or "").lower()
        self.log: deque[str] = deque(maxlen=KEPT_MESSAGES)
        self._logging = logging
        self._calls = FOUND[description.fmiVersion[0], way or ways(description)[0]](name, description)
        self._calls.tolerance = default_tolerance(description) if tolerance is None else tolerance
        if isinstance(self._calls, ModelExchange2):
            self._calls.solver_name = solver
        optional = self._optional(description, connected | start.keys())
        self._ports = ports = Ports(description, connected, recorded, optional)
        self._fmi3, self._kinds = ports.fmi3, ports.kinds
        self._variables = {v.name: v for v in description.modelVariables}
        self.inputs, self.outputs = ports.inputs, ports.outputs
        self.exact_inputs, self.exact_outputs = ports.exact_inputs, ports.exact_outputs
        self._fmu: Any = None
        self._component: Any = None
        self._folder: Path | None = None
        self._unpacked: Path | None = None
        self._initialized = False
        self._time = 0.0
        self._stopped: BaseException | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process makes its own of the same."""
        return self._made_of

    def started_from(self, start: Mapping[str, Any], unpacked: Path | None = None) -> FmuBlock:
        """Another instance, with these start values; `unpacked`: where the FMU lies already, which stays as it is."""
        make, (name, path, description, _, connected) = self._made_of
        block = make(name, path, description, start, connected)
        block._unpacked = unpacked
        return block

    def _optional(self, description: Any, given: frozenset[str]) -> frozenset[str]:
        """Inputs without a source or a value that the FMU says need none; only FMUs of ours say so."""
        free = {v.name for v in description.modelVariables if v.causality == "input"} - given
        return optional_inputs(self.path) & free if free and description.author == AUTHOR else frozenset()

    def depends_on(self, name: str, outputs: Collection[str] | None = None) -> bool | None:
        variable = self._variables.get(name) or self._variables.get(name.rpartition("[")[0])
        needed, declared = self._needed if outputs is None else self._needed_for(outputs)
        if id(variable) in needed:
            return True
        return False if declared and self.description.fmiVersion != "1.0" else None

    @cached_property
    def _needed(self) -> tuple[frozenset[int], bool]:
        """Variables, by their id, on which some output depends, and whether every output says on which."""
        return self._needed_for(None)

    def _needed_for(self, outputs: Collection[str] | None) -> tuple[frozenset[int], bool]:
        known = [
            unknown.dependencies
            for unknown in self.description.outputs
            if outputs is None or any(n in outputs for n in (unknown.variable.name, *element_names(unknown.variable)))
        ]
        return frozenset(id(v) for needed in known if needed is not None for v in needed), None not in known

    def bind(self, row: Row, first: int, beside: list[Any] | None = None, first_beside: int = 0) -> None:
        exact = len(self.exact_inputs) + len(self.exact_outputs)
        self._row, self._beside = row, [None] * exact if beside is None else beside
        ports = self._ports
        ports.place(first, first_beside)
        address = ctypes.addressof(row)
        self._put_arguments, self._other_puts = ports.split(ports.fed, address)
        self._reading = ports.split(ports.read, address)
        self._out, self._finite = ports.real_outputs()

    def open(self, start: float, stop: float) -> None:
        self._time = start
        self._unpack()
        self._load()
        self._begin(start, stop)

    def start(self) -> None:
        with self._failing():
            self._calls.leave()
        self._initialized = True
        self._get_arguments, self._other_gets = self._reading
        self._do_step = self._calls.stepping()
        if isinstance(self._calls, ModelExchange2):
            self._do_step = self._judged(self._calls, self._do_step)

    def put(self) -> None:
        if self._watched is not None:
            self._put_if_changed()
        elif self._ports.fed:
            self._put_all()

    def get(self) -> None:
        arguments = self._get_arguments
        if arguments is not None:
            status = self._get_real(self._component, *arguments)
            if status:
                self._judge(self._real_getter, status)
            values = self._row[self._out]
            if not math.isfinite(sum(values)):
                self._not_finite(values)
        if self._other_gets:
            for exchange in self._other_gets:
                self._read_in(exchange)
                self._check_finite(exchange)

    def advance(self, t: float, h: float) -> None:
        status = self._do_step(self._component, t, h, 1)
        if status:
            self._time = t
            self._judge(self._step_name, status)
        self._time = t + h

    def stepping(self, doing: MutableSequence[int], first: int) -> Callable[[float, float], None]:
        step = self._calls.at_once(self._component)
        fed = bool(self._ports.fed)
        straight = self._put_arguments is not None and not self._other_puts
        if step is None or (fed and not straight) or self._get_arguments is None or self._other_gets:
            return in_turn(self, doing, first, puts=fed)
        return self._bare_stepping(step, doing, first)

    def _bare_stepping(self, step: AtOnce, doing: MutableSequence[int], first: int) -> Callable[[float, float], None]:
        """As `in_turn` of values that go straight between FMU and row: all looked up, every argument made before."""
        calls, instance = self._calls, ctypes.c_void_p(self._component)
        get = partial(calls.untyped(self._real_getter), instance, *self._ports.straight(self._get_arguments))
        put = None
        if self._put_arguments is not None:
            put = partial(calls.untyped(self._real_setter), instance, *self._ports.straight(self._put_arguments))
        do_step, at, over = step
        outputs, isfinite = memoryview(self._row).cast("B").cast("d")[self._out], math.isfinite
        putting, advancing, getting = first + PUT, first + ADVANCE, first + GET

        def once(t: float, h: float) -> None:
            if put is not None:
                doing[0] = putting
                if status := put():
                    self._judge(self._real_setter, status)
            doing[0] = advancing
            at.value, over.value = t, h
            if status := do_step():
                self._time = t
                self._judge(self._step_name, status)
            self._time = t + h
            doing[0] = getting
            if status := get():
                self._judge(self._real_getter, status)
            if not isfinite(sum(outputs)):
                self._not_finite(outputs.tolist())

        return once

    # -- stepped by C -------------------------------------------------------------------------

    def slot(self) -> Slot | str:
        """Itself for C, from now on; or why not."""
        version = {CoSimulation2: 2, CoSimulation3: 3}.get(type(self._calls), 0)
        if self.nominal_step:
            return f"{self.name} is made of Python, by pythonfmu"
        if not version:
            return f"{self.name} is of FMI {self.description.fmiVersion} {self._calls.way}"
        if any(exchange.kind.beside for exchange in (*self._ports.fed, *self._ports.read)):
            return f"{self.name} has values that no double holds"
        puts = [move(self._setters[e.kind.function], e, self._row) for e in self._ports.fed]
        gets = [move(self._getters[e.kind.function], e, self._row, len(self._finite_of(e))) for e in self._ports.read]
        step = self._calls.bare_step()
        return fmu_slot(version, step, self._component, puts, gets, self._time)

    def came_to(self, t: float) -> None:
        """C has stepped it to `t` [s]; raises what stopped this process while the FMU spoke."""
        self._time = t
        if self._stopped is not None:
            stopped, self._stopped = self._stopped, None
            raise stopped

    def tell(self, why: Why, plan: Plan, slot: Slot) -> None:
        """What C met, as if it had been met here: SimulationError, EndedEarly; nothing of a warning."""
        exchanges = self._ports.fed if plan.called == PUT or why == Why.UNFIT else self._ports.read
        if why == Why.NOT_FINITE:
            self._check_finite(self._ports.read[plan.moving])
        elif why == Why.UNFIT:
            self._write(exchanges[plan.moving])
        elif why == Why.TERMINATED:
            raise ended(self.name, slot.reached)
        elif plan.called == ADVANCE:
            self._judge(self._step_name, plan.status)
        else:
            verb = "Set" if plan.called == PUT else "Get"
            self._judge(f"{self._calls.prefix}{verb}{exchanges[plan.moving].kind.function}", plan.status)

    def change(self, values: Mapping[str, Any]) -> None:
        """Set tunable parameters and inputs while it runs."""
        with self._failing():
            self._calls.inputs_changed(lambda: self._set(values))
        for exchange in self._ports.unfed:
            self._read_in(exchange)

    @property
    def rolls_back(self) -> bool:
        """It gives its state away, takes it back, and makes steps of any length."""
        about = self._made_of[1][2].coSimulation
        states = getattr(about, "canGetAndSetFMUstate", False) or getattr(about, "canGetAndSetFMUState", False)
        anyhow = about is not None and about.canHandleVariableCommunicationStepSize and sampled_by(self.path) is None
        return bool(states and anyhow and isinstance(self._calls, CoSimulation2 | CoSimulation3))

    def saved(self) -> Any:
        """Its state, to be taken back once."""
        with self._failing():
            return self._fmu.getFMUState() if self._fmi3 else self._fmu.getFMUstate()

    def take_back(self, state: Any) -> None:
        """Be as it was, and free that state."""
        with self._failing():
            if self._fmi3:
                self._fmu.setFMUState(state)
                self._fmu.freeFMUState(state)
            else:
                self._fmu.setFMUstate(state)
                self._fmu.freeFMUstate(state)

    def close(self) -> None:
        self._unload()
        if self._folder is not None and self._folder != self._unpacked:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None

    def last_words(self) -> str:
        """The FMU's last log message, on one line."""
        return without_wrapping(" ".join(self.log[-1].split())) if self.log else ""

    # -- life ---------------------------------------------------------------------------------

    def _unpack(self) -> None:
        if self._unpacked is not None:
            self._folder = self._unpacked
            return
        try:
            self._folder = Path(tempfile.mkdtemp(prefix="cosim-fmu-"))
            unpack(self.path, self._folder)
        except Exception as error:  # FMPy raises bare Exceptions, zipfile its own
            if is_full(error):
                full = (
                    f"the disk is full: no room to unpack {self.path.name} in the folder for temporary files (TMPDIR)"
                )
                raise DiskFull(self.name, self._time, full) from None
            raise FmuError(f"{self.path} does not load: {error}") from None

    def _load(self) -> None:
        assert self._folder is not None
        here = os.getcwd()
        try:
            library, warning = library_of(self._folder, self.description, self._calls.identifier)
            if warning:
                self._remember(warning)
            try:
                self._calls.load(self._folder, library)
            except Exception as error:
                if "undefined symbol" not in str(error) or not offer_libm():
                    raise
                self._calls.load(self._folder, library)
            # pythonfmu gives its reasons to who asks for debugging, and to nobody else
            talks = self._logging or self.nominal_step
            self._calls.instantiate(self._listen, talks)
            if talks and not self._logging:
                self._calls.limit_logging()
        except Exception as error:  # FMPy raises bare Exceptions; the FMU's own words say more
            raise FmuError(f"{self.path} does not load: {self.last_words() or error}") from None
        finally:
            os.chdir(here)  # FMPy loads from within the FMU's folder
        self._fmu, self._component = self._calls.fmu, self._calls.fmu.component
        let_go_at_exit(self._folder)  # of what pythonfmu, if it made this FMU, releases twice
        self._bare_functions()

    def _begin(self, start: float, stop: float) -> None:
        """Enter initialization at `start`."""
        self._time, self._initialized = start, False
        self._calls.start_time, self._calls.stop_time = start, stop
        readable = self._calls.readable_before_start
        self._get_arguments, self._other_gets = self._reading if readable else (None, ())
        with self._failing():
            self._calls.prepare()
            self._set(self.start_values)
            self._calls.enter()
            # again, for some FMUs (20-sim) forget what they were given before
            self._set({n: v for n, v in self.start_values.items() if self._given_again(n)})
        if readable:
            for exchange in self._ports.inward:
                self._read_in(exchange)
        else:
            self._show_start_values()
        model_exchange = isinstance(self._calls, ModelExchange2)
        self._watched: list[Any] | None = [] if model_exchange and self._ports.fed else None

    def _given_again(self, name: str) -> bool:
        variable = self._variables.get(name)
        return (
            self._calls.readable_before_start
            and variable is not None
            and (variable.causality == "input" or variable.initial == "exact")
            and variable.causality != "structuralParameter"
        )

    def _unload(self) -> None:
        fmu, self._fmu = self._fmu, None
        if fmu is not None:
            try:
                if self._initialized:
                    fmu.terminate()
            except Exception as error:  # the run is over; the FMU's refusal is logged, not raised
                self.log.append(str(error))
            fmu.freeInstance()
        self._initialized = False

    def _bare_functions(self) -> None:
        calls = self._calls
        real = "Float64" if self._fmi3 else "Real"
        self._real_setter, self._real_getter = f"{calls.prefix}Set{real}", f"{calls.prefix}Get{real}"
        self._step_name = f"{calls.prefix}DoStep"
        self._set_real, self._get_real = (
            calls.bare(calls.exchange, f"Set{real}"),
            calls.bare(calls.exchange, f"Get{real}"),
        )
        self._setters: dict[str, Any] = {}
        self._getters: dict[str, Any] = {}
        for exchange in (*self._ports.inward, *self._ports.read):
            kind = exchange.kind.function
            if exchange.buffer is not None and kind not in self._getters:
                self._getters[kind] = calls.bare(calls.exchange, f"Get{kind}")
                self._setters[kind] = calls.bare(calls.exchange, f"Set{kind}")

    # -- values -------------------------------------------------------------------------------

    def _target(self, exchange: Exchange) -> Any:
        return self._beside if exchange.kind.beside else self._row

    def _read_in(self, exchange: Exchange) -> None:
        """Values of the FMU to where they stand."""
        function = exchange.kind.function
        if exchange.buffer is None:
            with self._failing():
                values = self._fmu.getBinary(exchange.vrs, exchange.count)
                self._target(exchange)[exchange.places] = [v or b"" for v in values]  # None: of no bytes, from NULL
            return
        status = self._getters[function](self._component, *exchange.arguments(self._fmi3))
        if status:
            self._judge(f"{self._calls.prefix}Get{function}", status)
        self._target(exchange)[exchange.places] = exchange.decoded()

    def _write(self, exchange: Exchange) -> None:
        """Values from where they stand to the FMU."""
        function, values = exchange.kind.function, self._target(exchange)[exchange.places]
        if exchange.buffer is None:
            with self._failing():
                self._fmu.setBinary(exchange.vrs, values)
            return
        try:
            exchange.encode(values)
        except ValueError as error:
            name, _, why = str(error).partition(": ")
            raise SimulationError(f"{self.name}.{name}", self._time, f"the input {why} of its type") from None
        status = self._setters[function](self._component, *exchange.arguments(self._fmi3))
        if status:
            self._judge(f"{self._calls.prefix}Set{function}", status)

    def _put_if_changed(self) -> None:
        """Of model exchange: inputs that are what they were are no event."""
        values = [self._target(e)[e.places] for e in self._ports.fed]
        if values == self._watched:
            return
        self._watched = values
        with self._failing():
            self._calls.inputs_changed(self._put_all)

    def _put_all(self) -> None:
        if self._put_arguments is not None:
            status = self._set_real(self._component, *self._put_arguments)
            if status:
                self._judge(self._real_setter, status)
        for exchange in self._other_puts:
            self._write(exchange)

    def _set(self, values: Mapping[str, Any]) -> None:
        """Give variables values, arrays as lists of theirs."""
        for name, value in values.items():
            variable = self._variables[name]
            exchange = Exchange(self._kinds[variable.type], [variable])
            given = value if isinstance(value, (list, tuple)) else [value] * exchange.count
            function = f"{self._calls.prefix}Set{exchange.kind.function}"
            if exchange.buffer is None:
                self._fmu.setBinary(exchange.vrs, [bytes.fromhex(v) if isinstance(v, str) else v for v in given])
                continue
            exchange.encode(given)
            # FMPy's own setters do not hand the status on
            setter = self._calls.bare(self._calls.exchange, f"Set{exchange.kind.function}")
            if status := setter(self._component, *exchange.arguments(self._fmi3)):
                self._judge(f"{function} of {name}", status)

    def _show_start_values(self) -> None:
        """Of FMI 1.0, whose inputs cannot be read yet: what they start from."""
        for exchange in self._ports.inward:
            text = exchange.kind.function == "String"
            shown: list[Any] = []
            for variable in exchange.variables:
                value = self.start_values.get(variable.name, variable.start)
                if exchange.kind.function == "Boolean" and isinstance(value, str):
                    value = value.strip() in {"true", "1"}
                shown.append(str(value or "") if text else float(value or 0.0))
            self._target(exchange)[exchange.places] = shown

    def _finite_of(self, exchange: Exchange) -> tuple[str, ...]:
        """Those of its scalars that must be finite, which come first: outputs of 64 and of 32 bits."""
        return self._ports.outputs_of(exchange) if exchange.kind.ctype in (ctypes.c_double, ctypes.c_float) else ()

    def _check_finite(self, exchange: Exchange) -> None:
        if names := self._finite_of(exchange):
            first = exchange.places.start
            self._not_finite(self._row[first : first + len(names)], names)

    def _not_finite(self, values: Sequence[float], names: Sequence[str] | None = None) -> None:
        for name, value in zip(self._finite if names is None else names, values, strict=True):
            if not math.isfinite(value):
                raise SimulationError(f"{self.name}.{name}", self._time, f"the value is {value}")

    # -- what goes wrong ----------------------------------------------------------------------

    def _listen(self, status: int, message: bytes | None) -> None:
        """A message of the FMU; what is no warning is debugging, kept where it was asked for."""
        try:
            if status >= WARNING or self._logging:
                self._remember((message or b"").decode("utf-8", "replace"))
        except (KeyboardInterrupt, Terminated) as stop:  # no exception passes through C
            self._stopped = stop

    def _remember(self, text: str) -> None:
        text = text[:LONGEST_MESSAGE]
        if text in self.log:  # a warning at every step is one
            self.log.remove(text)
        self.log.append(text)

    @contextmanager
    def _failing(self) -> Iterator[None]:
        """Tell which of FMPy's calls failed."""
        from fmpy.fmi1 import FMICallException

        try:
            yield
        except FMICallException as error:
            self._judge(error.function, error.status)

    def _judged(self, calls: ModelExchange2, step: Step) -> Step:
        """A step of model exchange, which is many calls: told is the one that failed, at its time."""
        from fmpy.fmi1 import FMICallException

        def judged(component: Any, t: float, h: float, flag: int) -> int:
            try:
                return step(component, t, h, flag)
            except FMICallException as error:
                self._time = calls.time
                self._judge(error.function, error.status)
                return 0

        return judged

    def _judge(self, function: str, status: int) -> None:
        """A status that is not OK: a warning is logged, an end that the FMU asked for is told, all else has failed."""
        if status == WARNING:
            self._remember(f"{function} returned Warning")
            return
        if status == DISCARD and function == self._step_name and (reached := self._calls.ended(self._time)) is not None:
            reason = f"{function} returned Discard: the FMU ended the simulation early"
            words = self.last_words()
            raise EndedEarly(self.name, reached, f"{reason}: {words}" if words else reason, readable=True)
        self._fail(function, status)

    def _fail(self, function: str, status: int) -> None:
        """Tell which call failed and why. After Fatal the instance is not touched again, as FMI demands."""
        reason = f"{function} returned {STATUS[status] if 0 <= status < len(STATUS) else status}"
        if status == FATAL:
            self._fmu = None
        if "KeyboardInterrupt" in self.last_words():  # it came while the FMU's Python ran
            raise KeyboardInterrupt
        if words := self.last_words():
            reason += f": {words}"
        raise SimulationError(self.name, self._time, reason)

    def names_any(self, pattern: str) -> bool:
        """A pattern such as `plant.*` names a variable of it."""
        return any(named(pattern, self.name, name) for name in self._variables)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is to be known of the FMU before it runs."""
        slips = slips_of(self.description)
        found = []
        if slips:
            more = f" (and {len(slips) - 1} more)" if len(slips) > 1 else ""
            found.append(f"{self.name}: {self.path.name} breaks FMI's rules, which is passed over: {slips[0]}{more}")
        kinds = {v.type for v in self.description.modelVariables} - self._kinds.keys()
        if kinds:
            found.append(f"{self.name}: variables of type {', '.join(sorted(kinds))} are not supported and left alone")
        return tuple(found)
