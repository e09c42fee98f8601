"""An FMU for repeated runs, with access to the state of cosim's own FMUs."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

from cosim.blocks.fmu import FmuBlock
from cosim.fmi.sampled import traits_of
from cosim.fmi.state import Memory, Own, own_of, with_memory


class RestartableFmu(FmuBlock):
    """An FMU that restarts without unpacking, by reset if possible."""

    def begin(self, values: Mapping[str, Any], start: float, stop: float) -> None:
        """Reset or reload the FMU, and enter initialization at `start` with new start values."""
        self.start_values = values
        if self.instance.fmu is None or not self._reset():
            self.instance.free()
            self._load()
        self._begin(start, stop)

    def own(self) -> Own:
        """Return the state that determines the future.

        Foreign FMUs raise ValueError, KeyError or TypeError.
        """
        return own_of(self._state())

    def remember(self, memory: Memory) -> None:
        """Write a memory into the state of a cosim FMU, since start values can express a constant past only."""
        state = with_memory(self._state(), memory)
        with self.instance.check_calls():
            fmu = self.instance.fmu
            pointer = fmu.deSerializeFMUstate(state)
            fmu.setFMUstate(pointer)
            fmu.freeFMUstate(pointer)

    def _state(self) -> bytes:
        with self.instance.check_calls():
            fmu = self.instance.fmu
            pointer = fmu.getFMUstate()
            state: bytes = fmu.serializeFMUstate(pointer)
            fmu.freeFMUstate(pointer)
        return state

    @cached_property
    def _is_ours(self) -> bool:
        return traits_of(self.path) is not None

    def _reset(self) -> bool:
        """Reset a cosim FMU; return False for foreign FMUs, of which some (20-sim) stand still after a reset."""
        if not self._is_ours:
            return False
        try:
            self.instance.fmu.reset()
        except Exception:  # FMPy raises bare Exceptions; without reset the FMU is loaded again.
            return False
        return True
