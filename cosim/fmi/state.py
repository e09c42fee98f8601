"""Serialized states of FMUs built by cosim, which `replay` reads and changes.

In the JSON of a Python FMU, "own" contains what determines the future: time, continuous state, and the memory of each
shaping effect. A native FMU writes doubles instead, in the layout of `cosim/fmi/native/instance.c`: a delay's command
history, then the memory of further effects.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

Own = list[Any]  # time [s], state, memory
STATE, MEMORY = 1, 2  # indices of parts of Own
JSON = b'{"'
# bytes of the GUID; number of doubles for sizes and flags, and the index of time among them
GUID, SIZES, FLAGS, TIME = 40, 6, 6, 2
Memory = Mapping[tuple[int, int], Any]  # (part, index) → value


def own_of(data: bytes) -> Own:
    """Return time, state and memory from the serialized state of an FMU; they determine the future.

    Bytes of another tool's FMU raise ValueError, KeyError or TypeError.
    """
    return _decode(data)[0]


def with_memory(data: bytes, memory: Memory) -> bytes:
    """Return the serialized state of an FMU with changed values of its memory."""
    own, encode = _decode(data)
    for (part, place), value in memory.items():
        if place >= len(own[part]):
            raise KeyError(f"index {place} is outside part {part} of a state")
        own[part][place] = value
    return encode()


def _decode(data: bytes) -> tuple[Own, Callable[[], bytes]]:
    """Return time, state and memory of a serialized state, and a function that serializes them after changes.

    Raises:
        ValueError: The bytes are not the state of an FMU of cosim.
    """
    own: Own
    if data.startswith(JSON):
        content = json.loads(data)
        t, state, memory = content["own"]
        own = content["own"] = [float(t), [*state], [*memory]]
        return own, lambda: json.dumps(content).encode()
    count = max(0, len(data) - GUID) // 8
    numbers = np.frombuffer(data[GUID:], count=count).tolist()
    if count >= SIZES and all(0 <= n < 1e9 for n in numbers[:SIZES]):
        inputs, variables, states, memories, owned, texts = map(int, numbers[:SIZES])
        first = SIZES + FLAGS + 2 * variables
        end, split = first + owned, first + states
        rows = int(numbers[end]) if end < count else -1
        size = rows * (1 + inputs)
        if rows >= 0 and len(data) == GUID + 8 * (end + 1 + size) + texts:
            table = np.reshape(numbers[end + 1 : end + 1 + size], (rows, 1 + inputs)).tolist()
            history = [[t, u] for t, *u in table]
            own = [numbers[SIZES + TIME], numbers[first:split], [history, *numbers[split : split + memories]]]

            def encode() -> bytes:
                commands, *values = own[MEMORY]
                numbers[first:split], numbers[split : split + memories] = own[STATE], values
                flat = [number for since, command in commands for number in (since, *command)]
                packed = np.array([*numbers[:end], len(commands), *flat]).tobytes()
                return data[:GUID] + packed + data[len(data) - texts :]

            return own, encode
    raise ValueError("not the state of an FMU built by cosim")
