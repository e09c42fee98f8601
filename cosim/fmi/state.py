"""Serialized states of cosim's FMUs, as read by `replay`.

In the JSON of a Python FMU, "own" has everything that determines the future: time, continuous state, and the memory of
each shaping effect. A native FMU writes doubles instead, in the layout of `cosim/fmi/native/instance.c`: a delay's
command history, then the memory of further effects.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

Own = list[Any]  # time [s], state, memory
STATE, MEMORY = 1, 2  # indices of parts of Own
JSON = b'{"'
# bytes of the GUID; doubles of sizes and flags, and the index of time among them
GUID, SIZES, FLAGS, TIME = 40, 6, 6, 2
Memory = Mapping[tuple[int, int], Any]  # (part, index) → value


def own_of(data: bytes) -> Own:
    """Return the part of an FMU state that determines the future.

    Foreign bytes raise ValueError, KeyError or TypeError.
    """
    if data.startswith(JSON):
        t, state, memory = json.loads(data)["own"]
        return [float(t), [*state], [*memory]]
    fixed, first, split, memories, history, _ = _parts_of_native(data)
    return [fixed[SIZES + TIME], fixed[first:split], [history, *fixed[split : split + memories]]]


def with_memory(data: bytes, memory: Memory) -> bytes:
    """Return an FMU state with changed memory."""
    if data.startswith(JSON):
        state = json.loads(data)
        for (part, place), value in memory.items():
            state["own"][part][place] = value
        return json.dumps(state).encode()
    fixed, first, split, memories, history, texts = _parts_of_native(data)
    for (part, place), value in memory.items():
        if (part, place) == (MEMORY, 0):
            history = value
        elif part == STATE and 0 <= place < split - first:
            fixed[first + place] = value
        elif part == MEMORY and place <= memories:
            fixed[split + place - 1] = value
        else:
            raise KeyError(f"index {place} is outside part {part} of a state")
    rows = [number for since, command in history for number in (since, *command)]
    return data[:GUID] + np.array([*fixed, len(history), *rows]).tobytes() + texts


def _parts_of_native(data: bytes) -> tuple[list[float], int, int, int, list[Any], bytes]:
    """Return the parts of a native FMU's state; raise ValueError for invalid bytes.

    Returns:
        Numbers before the history, indices of the first state and of the first memory, number of memories, history of
        commands, and texts.
    """
    count = max(0, len(data) - GUID) // 8
    numbers = np.frombuffer(data[GUID:], count=count).tolist()
    if count >= SIZES and all(0 <= n < 1e9 for n in numbers[:SIZES]):
        inputs, variables, states, memories, own, texts = map(int, numbers[:SIZES])
        first = SIZES + FLAGS + 2 * variables
        end, split = first + own, first + states
        rows = int(numbers[end]) if end < count else -1
        size = rows * (1 + inputs)
        if rows >= 0 and len(data) == GUID + 8 * (end + 1 + size) + texts:
            table = np.reshape(numbers[end + 1 : end + 1 + size], (rows, 1 + inputs)).tolist()
            history = [[t, u] for t, *u in table]
            return numbers[:end], first, split, memories, history, data[len(data) - texts :]
    raise ValueError("not the state of an FMU built by cosim")
