"""Input of an identification before any simulation: protocol, model and recordings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cosim.base.errors import Fault, InputError, NotExecuted, refuse
from cosim.base.registry import is_model
from cosim.loading.file import load_model, named_model
from cosim.model import Model
from plant.identification.cells import Cells, calibrated
from plant.identification.planned import planned_faults
from plant.identification.protocol import CHANNELS, Protocol, partly_read
from plant.identification.recording_faults import recording_faults, repeated
from plant.identification.recordings import Recording, read_recordings

NUMBERS = {"thrust_offset", "thrust_slope", "ground_effect_exponent", "lag", "assembly_arm"}  # of a power-train


@dataclass(frozen=True)
class Prepared:
    """A protocol, the model of its parameters, and measured recordings by test."""

    protocol: Protocol
    model: Model
    measured: dict[str, list[Recording]]


def read_protocol(path: Path) -> Protocol:
    """Read a protocol.

    Raises:
        InputError: Every fault that does not depend on model and recordings.
    """
    protocol, faults = partly_read(path)
    faults = faults or planned_faults(protocol.yaml, protocol.file, protocol.known)
    refuse(faults)
    return protocol


def prepare(path: Path) -> Prepared:
    """Read a protocol, its model and its recordings.

    Raises:
        InputError: Every fault of them.
    """
    protocol, faults = partly_read(path)
    if not faults:
        faults += planned_faults(protocol.yaml, protocol.file, protocol.known)
    model, unknown = None, None
    try:
        model = _model_of(protocol)
    except InputError as error:
        faults += error.faults
    except NotExecuted as error:
        unknown = error
    measured: dict[str, list[Recording]] = {}
    try:
        measured = _measured(protocol)
    except InputError as error:
        faults += error.faults
    if unknown is not None and not faults:
        raise unknown
    if faults or model is None:
        raise InputError(faults)
    return Prepared(protocol, model, measured)


def _model_of(protocol: Protocol) -> Model:
    """Return the model whose parameters the power-train sets."""
    text, where = protocol.file.model, protocol.yaml.place(("model",))
    try:
        model = named_model(text) if is_model(text) else load_model(text, protocol.folder, protocol.yaml).model
    except InputError as error:
        raise InputError(
            [Fault(protocol.yaml.path, *where, str(f)) if f.file != protocol.yaml.path else f for f in error.faults]
        ) from None
    if not NUMBERS & {p.name for p in model.parameters}:
        lacking = f"{text} has none of {', '.join(sorted(NUMBERS))}: nothing that is identified is a parameter of it"
        raise InputError([Fault(protocol.yaml.path, *where, f"{lacking}; name the model of what stands on the bench")])
    return model


def _measured(protocol: Protocol) -> dict[str, list[Recording]]:
    """Return the measured recordings after all checks."""
    faults: list[Fault] = []
    found: dict[str, list[Recording]] = {}
    cells: Cells | None = None
    if all(c in protocol.file.cells and protocol.file.cells[c].points for c in CHANNELS):
        try:
            cells = calibrated(protocol, {})
        except ValueError as error:
            faults.append(cell_fault(protocol, error))
    for name, test in protocol.file.tests.named_tests():
        if not test.files:
            continue
        found[name], unread = read_recordings(protocol, name)
        faults += [*unread, *repeated(found[name])]
        if cells is not None:
            faults += recording_faults(protocol, name, found[name], cells, whole=not unread)
    refuse(faults)
    return found


def cell_fault(protocol: Protocol, error: ValueError) -> Fault:
    """Return the fault of a cell at its line."""
    name = str(error).partition(":")[0].removeprefix("cells.")
    return protocol.yaml.fault(("cells", name), str(error), key=True)
