"""States of FMUs, to repeat steps: saved, restored and freed, with each call announced."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from cosim.blocks.fmu import FmuBlock
from cosim.isolation.rows import OTHER


class Announcer(Protocol):
    """A master that stores the next call, so that a crash or a hang is blamed on its component."""

    def announce(self, component: Any, call: int = OTHER) -> None:
        """Store the next call."""


def save(master: Announcer, fmus: Sequence[FmuBlock]) -> list[Any]:
    """Return the state of each FMU."""
    states = []
    for fmu in fmus:
        master.announce(fmu)
        states.append(fmu.instance.save_state())
    return states


def restore(master: Announcer, fmus: Sequence[FmuBlock], states: Sequence[Any], *, keep: bool = False) -> None:
    """Restore the state of each FMU, and free the states unless `keep` is set."""
    for fmu, state in zip(fmus, states, strict=True):
        master.announce(fmu)
        fmu.instance.restore_state(state, keep=keep)


def free(master: Announcer, fmus: Sequence[FmuBlock], states: Sequence[Any]) -> None:
    """Free saved states."""
    for fmu, state in zip(fmus, states, strict=True):
        master.announce(fmu)
        fmu.instance.free_state(state)
