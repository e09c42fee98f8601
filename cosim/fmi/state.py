"""Serialized state of a cosim FMU, as bytes for the host.

Plain JSON. "own" holds everything that determines the future: time, continuous state, and the memory of each shaping
effect. The slave writes and reads the state, and a replay analyses it. A native FMU writes doubles instead, as laid out
in `cosim/fmi/native/instance.c`: its memory is a delay's command history, then the memory of further effects.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

Own = list[Any]  # time [s], state, memory
STATE, MEMORY = 1, 2  # indices of parts of Own
JSON = b'{"'
# bytes of the GUID; doubles of sizes and flags, and the index of time among them
GUID, SIZES, FLAGS, TIME = 40, 6, 6, 2
Memory = Mapping[tuple[int, int], Any]  # (part, index) → value


def to_bytes(state: Mapping[str, Any]) -> bytes:
    """Return the state as bytes; floats are reproduced exactly."""
    return json.dumps(state).encode()


def own_of(data: bytes) -> Own:
    """Return the part of an FMU state that determines the future.

    Foreign bytes raise ValueError, KeyError or TypeError.
    """
    if not data.startswith(JSON):
        return _Doubles(data).own
    t, state, memory = json.loads(data)["own"]
    return [float(t), [*state], [*memory]]


def with_memory(data: bytes, memory: Memory) -> bytes:
    """Return an FMU state with changed memory."""
    if not data.startswith(JSON):
        return _Doubles(data).bytes_with(memory)
    state = json.loads(data)
    for (part, place), value in memory.items():
        state["own"][part][place] = value
    return to_bytes(state)


class _Doubles:
    """State of a native FMU, parsed from its bytes; invalid bytes raise ValueError."""

    def __init__(self, data: bytes) -> None:
        count = (len(data) - GUID) // 8
        if count < SIZES:
            raise ValueError("not the state of an FMU of ours")
        self.head, numbers = data[:GUID], list(struct.unpack_from(f"{count}d", data, GUID))
        if not all(0 <= n < 1e9 for n in numbers[:SIZES]):
            raise ValueError("not the state of an FMU of ours")
        self.inputs, variables, self.states, self.memories, own, texts = map(int, numbers[:SIZES])
        self.first = SIZES + FLAGS + 2 * variables  # index of the part that determines the future
        fixed = self.first + own + 1
        if fixed > count or len(data) != GUID + 8 * (fixed + int(numbers[fixed - 1]) * (1 + self.inputs)) + texts:
            raise ValueError("not the state of an FMU of ours")
        self.texts = data[len(data) - texts :]
        self.fixed, rows = numbers[: fixed - 1], numbers[fixed : fixed + int(numbers[fixed - 1]) * (1 + self.inputs)]
        width = 1 + self.inputs
        self.history = [[rows[k], rows[k + 1 : k + width]] for k in range(0, len(rows), width)]

    @property
    def own(self) -> Own:
        """Return the part of the state that determines the future: time, continuous state and memory."""
        split = self.first + self.states
        memory = [self.history, *self.fixed[split : split + self.memories]]
        return [self.fixed[SIZES + TIME], self.fixed[self.first : split], memory]

    def bytes_with(self, memory: Memory) -> bytes:
        """Return the bytes of the state with changed values."""
        numbers, history = list(self.fixed), self.history
        for (part, place), value in memory.items():
            if (part, place) == (MEMORY, 0):
                history = value
            elif part == STATE and 0 <= place < self.states:
                numbers[self.first + place] = value
            elif part == MEMORY and place <= self.memories:
                numbers[self.first + self.states + place - 1] = value
            else:
                raise KeyError(f"no place {place} in part {part} of a state")
        rows = [number for since, command in history for number in (since, *command)]
        numbers += [float(len(history)), *rows]
        return self.head + struct.pack(f"{len(numbers)}d", *numbers) + self.texts
