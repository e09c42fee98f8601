"""What is set from Python, as the command line takes it: NAME=VALUE."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.errors import Fault, InputError

Given = Mapping[str, Any] | Sequence[str]


def given(values: Given | None, name: str = "set") -> Given:
    """A mapping or texts as they are, one text as a list of it; of what is neither InputError, which names it."""
    if values is None:
        return ()
    if isinstance(values, str):
        return (values,)
    if isinstance(values, Mapping):
        return dict(values)
    if isinstance(values, Sequence) and all(isinstance(v, str) for v in values):
        return tuple(values)
    cure = f'give a mapping, {{"name": value}}, or a list of "name=value", in place of {values!r:.60}'
    raise InputError([Fault(Path(name), 0, 0, cure)])


def texts(values: Given | None, name: str = "set") -> Sequence[str]:
    """NAME=VALUE each; InputError of what is neither a mapping nor texts."""
    found = given(values, name)
    return [f"{n}={as_yaml(v)}" for n, v in found.items()] if isinstance(found, Mapping) else found


def as_yaml(value: Any) -> str:
    """A value of Python as --set takes it."""
    if isinstance(value, os.PathLike):
        return json.dumps(os.fspath(value))
    return json.dumps(value.tolist() if hasattr(value, "tolist") else value)  # numbers and arrays of numpy
