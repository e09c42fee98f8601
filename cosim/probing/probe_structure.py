"""Structure of a binary: dependencies, pairs, ports, storages, time constants and acting parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType

from cosim.base.errors import InputError
from cosim.base.scratch import temporary_folder
from cosim.blocks.description import Way, ways
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.logs.log import Log
from cosim.probing.co_simulation import co_simulation_structure
from cosim.probing.exchange_structure import exchange_structure
from cosim.probing.fmu_structure import Structure
from cosim.probing.log_runs import Course, sine_course
from cosim.probing.prober import LIMITS, MODULES, Prober
from cosim.storage.archive import unpack


def probe_structure(
    fmu: Path,
    logs: Sequence[Log] = (),
    values: Mapping[str, float] = MappingProxyType({}),
    *,
    way: Way | None = None,
    limits: Limits = LIMITS,
) -> Structure:
    """Return the structure of a binary, from simulations along logs, or along small sines without logs.

    Args:
        values: Start values by name.
        way: Interface to probe; None prefers model exchange.
        limits: Limits of each simulation.

    Raises:
        InputError: The FMU lacks the interface.
        FmuError: The FMU is invalid or does not load.
        SimulationError: The FMU fails, crashes or hangs at its start.
    """
    path = Path(fmu).resolve()
    with ExitStack() as stack:
        place = stack.enter_context(temporary_folder("probe"))
        worker = stack.enter_context(Worker(*MODULES))
        prober = Prober(path, values, worker, place, limits)
        offered = ways(prober.description)
        chosen = way or ("model-exchange" if "model-exchange" in offered else "co-simulation")
        if chosen not in offered:
            raise InputError.at(path, f"has no usable interface for {chosen}; it offers {', '.join(offered)}")
        unpack(path, place)
        courses = [Course.of(log) for log in logs] or [sine_course(prober.description, values)]
        if chosen == "co-simulation":
            return co_simulation_structure(prober, courses)
        return exchange_structure(prober, courses)
