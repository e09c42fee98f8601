"""The state of an FMU of ours between two calls, as the bytes that FMI hands to a host.

JSON of plain numbers. What decides the future stands under "own": time, continuous state, memory of each shaping
effect. The slave writes and reads it; a replay takes it apart. A native FMU writes doubles in place of JSON, which
`cosim/fmi/native/instance.c` lays out: the memory there is a delay's history of commands, then what other effects
remember.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

Own = list[Any]  # time [s], state, memory
STATE, MEMORY = 1, 2  # parts of that
JSON = b'{"'
GUID, SIZES, FLAGS, TIME = 40, 6, 6, 2  # bytes of the GUID; doubles of sizes and flags, and the time's place in these
Memory = Mapping[tuple[int, int], Any]  # part and place in that → what stands there


def to_bytes(state: Mapping[str, Any]) -> bytes:
    """The state as bytes: repr of a float reads back bit for bit."""
    return json.dumps(state).encode()


def own_of(data: bytes) -> Own:
    """What decides the future; ValueError, KeyError or TypeError where the bytes are not of an FMU of ours."""
    if not data.startswith(JSON):
        return _Doubles(data).own
    t, state, memory = json.loads(data)["own"]
    return [float(t), [*state], [*memory]]


def with_memory(data: bytes, memory: Memory) -> bytes:
    """The same state with other values at some places of what decides the future."""
    if not data.startswith(JSON):
        return _Doubles(data).bytes_with(memory)
    state = json.loads(data)
    for (part, place), value in memory.items():
        state["own"][part][place] = value
    return to_bytes(state)


class _Doubles:
    """The state of a native FMU, taken apart; ValueError where the bytes are none."""

    def __init__(self, data: bytes) -> None:
        count = (len(data) - GUID) // 8
        if count < SIZES:
            raise ValueError("not the state of an FMU of ours")
        self.head, numbers = data[:GUID], list(struct.unpack_from(f"{count}d", data, GUID))
        if not all(0 <= n < 1e9 for n in numbers[:SIZES]):
            raise ValueError("not the state of an FMU of ours")
        self.inputs, variables, self.states, self.memories, own, texts = map(int, numbers[:SIZES])
        self.first = SIZES + FLAGS + 2 * variables  # of what decides the future
        fixed = self.first + own + 1
        if fixed > count or len(data) != GUID + 8 * (fixed + int(numbers[fixed - 1]) * (1 + self.inputs)) + texts:
            raise ValueError("not the state of an FMU of ours")
        self.texts = data[len(data) - texts :]
        self.fixed, rows = numbers[: fixed - 1], numbers[fixed : fixed + int(numbers[fixed - 1]) * (1 + self.inputs)]
        width = 1 + self.inputs
        self.history = [[rows[k], rows[k + 1 : k + width]] for k in range(0, len(rows), width)]

    @property
    def own(self) -> Own:
        """Time, state, memory."""
        split = self.first + self.states
        memory = [self.history, *self.fixed[split : split + self.memories]]
        return [self.fixed[SIZES + TIME], self.fixed[self.first : split], memory]

    def bytes_with(self, memory: Memory) -> bytes:
        """The bytes, with other values at some places."""
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
