"""Input of an identification, prepared before any simulation: protocol, model and recordings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cosim.base.errors import Fault, InputError, NotExecuted, refuse
from cosim.base.registry import is_model
from cosim.loading.file import load_model, named_model
from cosim.model import Model
from plant.identification import messages
from plant.identification.cells import Cells, calibrate
from plant.identification.checks import recording_faults
from plant.identification.planned import planned_faults
from plant.identification.protocol import CHANNELS, Protocol, read_partly
from plant.identification.recordings import Recording, read_recordings

NUMBERS = {"thrust_offset", "thrust_slope", "ground_effect_exponent", "lag", "assembly_arm"}  # of a power-train


@dataclass(frozen=True)
class BenchInput:
    """A protocol, the model whose parameters it identifies, and measured recordings by test."""

    protocol: Protocol
    model: Model
    measured: dict[str, list[Recording]]


def prepare(path: Path) -> BenchInput:
    """Read a protocol, its model and its recordings.

    Raises:
        InputError: Every fault of these files.
    """
    protocol, faults = read_partly(path)
    faults = faults or planned_faults(protocol.yaml, protocol.file, protocol.bench)
    model: Model | None = None
    not_executed: NotExecuted | None = None
    measured: dict[str, list[Recording]] = {}
    try:
        model = _model_of(protocol)
    except InputError as error:
        faults += error.faults
    except NotExecuted as error:
        not_executed = error
    try:
        measured = _read_measured(protocol)
    except InputError as error:
        faults += error.faults
    refuse(faults)
    if not_executed is not None:
        raise not_executed
    assert model is not None
    return BenchInput(protocol, model, measured)


def _model_of(protocol: Protocol) -> Model:
    """Return the protocol's model; raise InputError if it has none of the parameters that tests identify."""
    text, where = protocol.file.model, protocol.yaml.place(("model",))
    try:
        model = named_model(text) if is_model(text) else load_model(text, protocol.folder, protocol.yaml).model
    except InputError as error:
        raise InputError(
            [f if f.file == protocol.yaml.path else Fault(protocol.yaml.path, *where, str(f)) for f in error.faults]
        ) from None
    if not NUMBERS & {p.name for p in model.parameters}:
        message = messages.MODEL_WITHOUT_NUMBERS(model=text, names=", ".join(sorted(NUMBERS)))
        raise InputError([Fault(protocol.yaml.path, *where, message)])
    return model


def _read_measured(protocol: Protocol) -> dict[str, list[Recording]]:
    """Return the measured recordings after all checks.

    With a wrong bench, only what does not depend on it is checked: a fault of the protocol must not be blamed on
    recordings.
    """
    faults: list[Fault] = []
    recordings: dict[str, list[Recording]] = {}
    cells: Cells | None = None
    if protocol.is_bench_right and all(c in protocol.file.cells and protocol.file.cells[c].points for c in CHANNELS):
        try:
            cells = calibrate(protocol, {})
        except InputError as error:
            faults += error.faults
    for name, test in protocol.file.tests.named_tests():
        if not test.files:
            continue
        recordings[name], unread = read_recordings(protocol, name)
        faults += unread
        if cells is not None:
            faults += recording_faults(protocol, name, recordings[name], cells, whole=not unread)
    refuse(faults)
    return recordings
