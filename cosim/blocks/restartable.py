"""An FMU that is run again and again, and of one of ours the state between its runs."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

from cosim.blocks.fmu import FmuBlock
from cosim.fmi.annotation import traits_of
from cosim.fmi.state import Memory, Own, own_of, with_memory


class RestartableFmu(FmuBlock):
    """An FMU that begins again without being unpacked, where it can be reset."""

    def begin(self, values: Mapping[str, Any], start: float, stop: float) -> None:
        """Enter initialization at `start` with these start values."""
        self.start_values = values
        if self.instance.fmu is None or not self._reset():
            self.instance.free()
            self._load()
        self._begin(start, stop)

    def own(self) -> Own:
        """What decides its future, of an FMU of ours; of another ValueError, KeyError or TypeError."""
        return own_of(self._state())

    def remember(self, memory: Memory) -> None:
        """Put this into the state of an FMU of ours: start values know but a constant past."""
        state = with_memory(self._state(), memory)
        with self.instance.failing():
            fmu = self.instance.fmu
            after = fmu.deSerializeFMUstate(state)
            fmu.setFMUstate(after)
            fmu.freeFMUstate(after)

    def _state(self) -> bytes:
        with self.instance.failing():
            fmu = self.instance.fmu
            held = fmu.getFMUstate()
            state: bytes = fmu.serializeFMUstate(held)
            fmu.freeFMUstate(held)
        return state

    @cached_property
    def _ours(self) -> bool:
        return traits_of(self.path) is not None

    def _reset(self) -> bool:
        """Of an FMU of ours: others (20-sim) return OK and stand still afterwards."""
        if not self._ours:
            return False
        try:
            self.instance.fmu.reset()
        except Exception:  # FMPy raises bare Exceptions; what cannot be reset is opened anew
            return False
        return True
