"""The state of an FMU of ours between two calls, as the bytes that FMI hands to a host.

JSON of plain numbers. What decides the future stands under "own": time, continuous state, memory of each shaping
effect. The slave writes and reads it; a replay takes it apart.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

Own = list[Any]  # time [s], state, memory
STATE, MEMORY = 1, 2  # parts of that
Memory = Mapping[tuple[int, int], Any]  # part and place in that → what stands there


def to_bytes(state: Mapping[str, Any]) -> bytes:
    """The state as bytes: repr of a float reads back bit for bit."""
    return json.dumps(state).encode()


def own_of(data: bytes) -> Own:
    """What decides the future; ValueError, KeyError or TypeError where the bytes are not of an FMU of ours."""
    t, state, memory = json.loads(data)["own"]
    return [float(t), [*state], [*memory]]


def with_memory(data: bytes, memory: Memory) -> bytes:
    """The same state with other values at some places of what decides the future."""
    state = json.loads(data)
    for (part, place), value in memory.items():
        state["own"][part][place] = value
    return to_bytes(state)
