"""`cosim check` of models: a model.yaml, a Python file or FILE.py:Class."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cosim.loading.file import LoadedModel, load_model, only_model, read_model
from cosim.loading.substep import with_substep
from cosim.storage.artefact import Checking


def check_model_file(path: Path, checking: Checking) -> list[str]:
    """Check a model.yaml and return notes on it; InputError lists its faults."""
    return substep_notes(read_model(path))


def check_model_class(path: Path, checking: Checking) -> list[str]:
    """Return notes on a model class; InputError lists faults.

    The class is `FILE.py:Class`, or the only class in FILE.py.
    """
    text = str(path)
    if text.endswith(".py:"):
        only_model(Path(text.removesuffix(":")))
        return []
    if not path.suffix.startswith(".py:"):
        text = f"{path}:{type(only_model(path)).__name__}"
    return substep_notes(load_model(text, Path()))


def substep_notes(loaded: LoadedModel, logs: Sequence[Any] = ()) -> list[str]:
    """Return notes on a chosen substep; raise InputError if none is suitable."""
    return [f"note: {note}" for note in with_substep(loaded, logs)[1]]
