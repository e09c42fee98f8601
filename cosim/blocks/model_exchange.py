"""Model exchange: the FMU gives derivatives, a solver integrates them between events, CVODE as in FMPy.

Events are of state (an event indicator crosses zero, located by the solver), of time (the FMU names the next one) and
of step (the FMU asks for one after a step of the solver); inputs that change are one too.
"""

from __future__ import annotations

from collections.abc import Callable
from math import isclose
from typing import Any

from cosim.blocks.description import Way
from cosim.blocks.fmi import EXCHANGE3, Calls, CoSimulation3, Listen, Step
from cosim.blocks.interface import EndedEarly
from cosim.blocks.solvers import Solver, solver
from cosim.errors import SimulationError

TOLERANCE = 1e-5  # relative, where nobody says another; FMPy's
LONGEST = 50  # the solver's steps are at most this part of the whole time, as FMPy's
MOST_EVENTS = 1000  # updates of discrete states at one time


class ModelExchange2(Calls):
    """FMI 2.0 model exchange."""

    way: Way = "model-exchange"

    def __init__(self, name: str, description: Any) -> None:
        super().__init__(name, description)
        self.time, self.next_event = 0.0, None
        self.solver: Any = None
        self.solver_name: Solver | None = None
        self._started = False

    next_event: float | None

    def _class(self) -> Any:
        from fmpy.fmi2 import FMU2Model

        return FMU2Model

    def prepare(self) -> None:
        self._started, self.solver = False, None
        self.fmu.setupExperiment(startTime=self.start_time, stopTime=self.stop_time)  # the tolerance is the solver's

    def leave(self) -> None:
        self.fmu.exitInitializationMode()
        self.time = self.start_time
        self._update()
        self.fmu.enterContinuousTimeMode()
        self.solver = self._solver()
        self._started = True

    def stepping(self) -> Step:
        return self._step

    def inputs_changed(self, take: Callable[[], None]) -> None:
        if not self._started:
            take()
            return
        self.fmu.enterEventMode()
        take()
        self._update()
        self.fmu.enterContinuousTimeMode()
        self.solver.reset(self.time)

    # -- within -------------------------------------------------------------------------------

    def _solver(self) -> Any:
        return solver(
            self.solver_name,
            self.fmu,
            states=self.description.numberOfContinuousStates,
            indicators=self.description.numberOfEventIndicators,
            start=self.start_time,
            longest=(self.stop_time - self.start_time) / LONGEST,
            tolerance=TOLERANCE if self.tolerance is None else self.tolerance,
        )

    def _step(self, component: Any, t: float, h: float, _: int) -> int:
        """To the communication point, over as many events as come."""
        end = t + h
        while self.time < end and not isclose(self.time, end):
            target, at_event = end, False
            if (event := self.next_event) is not None:
                if target > event and not isclose(target, event):
                    target = event
                at_event = isclose(target, event)
            state_event, self.time = self._integrate(target)
            self.fmu.setTime(self.time)
            step_event = False
            if self.description.modelExchange.needsCompletedIntegratorStep:
                step_event, terminate = self.fmu.completedIntegratorStep()
                if terminate:
                    self._end()
            if state_event or at_event or step_event:
                self.fmu.enterEventMode()
                self._update()
                self.fmu.enterContinuousTimeMode()
                self.solver.reset(self.time)
        return 0

    def _integrate(self, target: float) -> tuple[bool, float]:
        try:
            state_event, _, time = self.solver.step(self.time, target)
        except RuntimeError as error:
            raise SimulationError(self.name, self.time, str(self.solver.failed or error)) from None
        if self.solver.failed is not None:
            raise self.solver.failed
        return bool(state_event), float(time)

    def _update(self) -> None:
        """Update discrete states until they need no more, and learn when the next event of time is."""
        for _ in range(MOST_EVENTS):
            more, terminate, _, _, defined, time = self._updated()
            if terminate:
                self._end()
            if not more:
                self.next_event = time if defined else None
                return
        raise SimulationError(self.name, self.time, f"its discrete states still change after {MOST_EVENTS} updates")

    def _updated(self) -> Any:
        return self.fmu.newDiscreteStates()

    def _end(self) -> None:
        raise EndedEarly(self.name, self.time, "the FMU ended the simulation", readable=False)


class ModelExchange3(ModelExchange2):
    """FMI 3.0 model exchange."""

    prefix, exchange = "fmi3", EXCHANGE3

    def _class(self) -> Any:
        from fmpy.fmi3 import FMU3Model

        return FMU3Model

    def instantiate(self, listen: Listen, logging: bool) -> None:
        CoSimulation3.instantiate(self, listen, logging)  # type: ignore[arg-type]

    def prepare(self) -> None:
        self._started, self.solver = False, None

    def enter(self) -> None:
        self.fmu.enterInitializationMode(startTime=self.start_time, stopTime=self.stop_time)

    def _updated(self) -> Any:
        return self.fmu.updateDiscreteStates()
