"""Places where terms can be added to an FMU, and the interface used for its refinement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from cosim.core.errors import FmuError, InputError, SimulationError
from cosim.fmi.description import Way, read_description, ways
from cosim.isolation.limits import Limits
from cosim.logs.log import Log
from cosim.model.quantities import Quantity
from cosim.probing.co_simulation import co_simulation_structure
from cosim.probing.fmu_structure import Structure
from cosim.probing.log_runs import Course, sine_course
from cosim.probing.model_exchange import exchange_structure
from cosim.probing.own_step import OwnStep, probe_own_step
from cosim.probing.prober import LIMITS, Prober

FASTEST = 20.0  # largest product of step and eigenvalue for a filter over the states


@dataclass(frozen=True, eq=False)
class Places:
    """Structure and behaviour of an FMU, and the interface used for its refinement.

    Attributes:
        reason: Reason for the interface.
        structure: Structure seen through the interface.
        own_step: Internal step in co-simulation, None if it has none.
    """

    reason: str
    structure: Structure
    own_step: OwnStep | None

    @property
    def findings(self) -> tuple[str, ...]:
        """Return sentences on an internal step, on failures, and on damping parameters that could not be used."""
        stops = [f"{stop}; the structure was measured before this" for stop in self.structure.stops]
        lost = [
            f"{d.parameter} damps {d.pair.velocity} and would show how forces there change other derivatives, but "
            "a second "
            "instance cannot be synchronized (events occur, or only one instance per process is allowed); forces at "
            f"{d.pair.velocity} act through an input, or on its derivative alone"
            for d in self.structure.directions
            if not d.in_step
        ]
        return (*([self.own_step.finding] if self.own_step else []), *lost, *stops)

    def as_json(self) -> dict[str, Any]:
        """Return the places as plain data."""
        s = self.structure
        shows = {shown: state for state, shown in reversed([*s.shown.items()])}

        def entry(q: Quantity, **more: Any) -> dict[str, Any]:
            return {"name": q.name, "unit": q.unit, "start": q.start, **more}

        return {
            "way": s.way,
            "reason": self.reason,
            **{name: [*map(asdict, getattr(s, name))] for name in ("pairs", "connections", "dampings", "events")},
            "storages": [entry(next(q for q in s.states or s.outputs if q.name == name)) for name in s.storages],
            "feeds": {name: asdict(port) for name, port in s.feeds.items()},
            "sensors": [entry(q, shows=shows.get(q.name, "")) for q in s.outputs],
            "inputs": [entry(q) for q in s.inputs],
            "parameters": [entry(p.quantity, acts=p.acts, starts=p.starts, failure=p.failure) for p in s.parameters],
            "largest_rate": s.largest_rate,
            "step": s.step,
            "own_step": self.own_step.length if self.own_step else 0.0,
            "findings": list(self.findings),
        }


def probe_structure(
    fmu: Path, logs: Sequence[Log] = (), *, way: Way | None = None, limits: Limits = LIMITS
) -> Structure:
    """Return the structure of an FMU, from simulations along logs, or along small sines without logs.

    Args:
        way: Interface to probe; None prefers model exchange.
        limits: Limits of each simulation.

    Raises:
        InputError: The FMU lacks the interface.
        FmuError: The FMU is invalid or does not load.
        SimulationError: The FMU fails, crashes or hangs at its start.
    """
    with Prober(fmu, limits=limits) as prober:
        offered = ways(prober.description)
        chosen = way or ("model-exchange" if "model-exchange" in offered else "co-simulation")
        if chosen not in offered:
            raise InputError.at(prober.path, f"has no usable interface for {chosen}; it offers {', '.join(offered)}")
        courses = [Course.of(log) for log in logs] or [sine_course(prober.description)]
        if chosen == "co-simulation":
            return co_simulation_structure(prober, courses)
        return exchange_structure(prober, courses)


def probe_places(fmu: Path, logs: Sequence[Log] = (), *, limits: Limits = LIMITS) -> Places:
    """Return the places of an FMU where terms can be added.

    Args:
        logs: Logs of the FMU; without logs, small sines drive the inputs.
        limits: Limits of each simulation.

    Raises:
        FmuError: The FMU is invalid or does not load.
        SimulationError: The FMU fails, crashes or hangs at its start.
    """
    offered = ways(read_description(fmu))
    own_step = probe_own_step(fmu, logs, limits=limits)
    way: Way = "co-simulation"
    reason = "it has no model exchange"
    if "model-exchange" in offered:
        try:
            structure = probe_structure(fmu, logs, way="model-exchange", limits=limits)
            way, reason = choose_way(structure, own_step, offered)
            if way == "model-exchange":
                return Places(reason, structure, own_step)
        except (InputError, FmuError, SimulationError) as error:
            if "co-simulation" not in offered:
                raise
            reason = f"its model exchange fails: {error!s}"
    return Places(reason, probe_structure(fmu, logs, way="co-simulation", limits=limits), own_step)


def choose_way(exchange: Structure, own_step: OwnStep | None, offered: Sequence[Way]) -> tuple[Way, str]:
    """Return the interface used for a refinement, and the reason.

    Args:
        exchange: Structure seen through model exchange.
    """
    stiffness = exchange.step * exchange.largest_rate
    events = sum(count.total for count in exchange.events)
    objection: str | None = None
    if events:
        objection = f"model exchange has {events} events along the logs"
    elif stiffness > FASTEST:
        objection = (
            f"the product of step and largest eigenvalue is {stiffness:.3g} in model exchange, above {FASTEST:g}"
        )
    elif not exchange.states:
        objection = "model exchange has no continuous states"
    if objection is None:
        return "model-exchange", (
            "its states and derivatives are accessible, no events occur along the logs, and the product of step "
            "and largest "
            f"eigenvalue is {stiffness:.2g}, at most {FASTEST:g}"
        )
    if "co-simulation" not in offered:
        return "model-exchange", f"it has no co-simulation, although {objection}"
    if own_step:
        return "model-exchange", (
            f"its co-simulation has an internal step of {own_step.length:.3g} s, above the step of the logs, "
            f"although {objection}"
        )
    return "co-simulation", objection
