"""`cosim check` of an FMU: its description, one step, and the experiments that it carries."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from cosim.base.errors import Fault, FmuError, InputError, refuse
from cosim.base.scratch import temporary_folder
from cosim.base.text import counted
from cosim.fmi.related_files import CHECKSUMS, CSV, EXPERIMENTS, MANIFEST, RelatedFile, read_experiments, read_manifest
from cosim.related import messages
from cosim.related.experiments import Carried, labels_text, run_experiment, with_default
from cosim.simulation.trial import check_loaded_fmu
from cosim.storage.archive import BadArchive, unpack
from cosim.storage.artefact import Checking


def check_fmu_file(path: Path, checking: Checking) -> list[str]:
    """Return notes on an FMU: violations of FMI rules, and how its experiments end.

    Without a worker nothing is run.

    Raises:
        InputError: The FMU cannot be run, its manifest of files is wrong, or an expected result is not reproduced.
    """
    notes = check_loaded_fmu(path, checking)
    with zipfile.ZipFile(path) as archive:
        if MANIFEST not in archive.namelist():
            return notes
    with temporary_folder("related") as scratch:
        try:
            unpack(path, scratch / "fmu")
            carried, more = _read(path, scratch / "fmu")
        except BadArchive as error:
            raise InputError.at(path, str(error), FmuError.exit_code) from None
        notes += more
        if checking.worker is None:
            return [*notes, messages.NOT_RUN(count=counted(len(carried), "experiment"))] if carried else notes
        faults: list[Fault] = []
        for number, each in enumerate(carried):
            lines, found = run_experiment(each, scratch / str(number))
            notes += lines
            faults += found
        refuse(faults)
    return notes


def _read(path: Path, folder: Path) -> tuple[list[Carried], list[str]]:
    """Return the experiments of an unpacked FMU, and notes on everything else that it carries."""
    manifest = read_manifest((folder / MANIFEST).read_bytes())
    expected = [file.source for file in manifest.files if _is_expected(file)]
    carried: list[Carried] = []
    notes: list[str] = [warning.after("warning: ") for warning in manifest.warnings]
    for file in manifest.files:
        member = file.member
        about = {"manifest": MANIFEST.rpartition("/")[2], "source": file.source, "role": file.role}
        if member is None:
            notes.append(messages.OUTSIDE(**about).after("warning: "))
            continue
        if not (folder / member).is_file():
            notes.append(messages.FILE_MISSING(**about).after("warning: "))
            if _is_expected(file):  # The experiment itself can be run.
                carried.append(with_default(path, folder, "", _part(file, expected)))
            continue
        notes += _checksum_warning(file, folder / member, about)
        if _is_expected(file):
            carried.append(with_default(path, folder, file.source, _part(file, expected)))
        elif file.role.startswith("experiment") and file.type == EXPERIMENTS:
            base = member.rpartition("/")[0]
            experiments = read_experiments(file.source, (folder / member).read_bytes())
            found = [Carried(path, folder, each, base, file.role) for each in experiments]
            notes += [warning for each in found for warning in _lost(file.source, each)]
            carried += found
        else:
            notes.append(_listed(file))
    return carried, notes


def _checksum_warning(file: RelatedFile, place: Path, about: Mapping[str, str]) -> list[str]:
    """Return a warning if a checksum is wrong, or of an unknown algorithm."""
    if not file.checksum or (agrees := file.agrees(place.read_bytes())):
        return []
    if agrees is None:
        return [messages.UNCHECKED(**about, type=file.checksum_type, known=", ".join(CHECKSUMS)).after("warning: ")]
    return [messages.OTHER_CHECKSUM(**about).after("warning: ")]


def _is_expected(file: RelatedFile) -> bool:
    """Return whether a file holds results of the default experiment."""
    return file.role == "result" and file.type == CSV


def _part(file: RelatedFile, expected: Sequence[str]) -> str:
    """Return the name that tells one of several files of expected results apart."""
    return file.source if len(expected) > 1 else ""


def _lost(name: str, carried: Carried) -> list[str]:
    """Return warnings on files that an experiment names and that are not in the FMU."""
    notes: list[str] = []
    for key in ("parameters", "stimuli", "references"):
        source = getattr(carried.experiment, key)
        path = carried.path(source)
        if source and (path is None or not path.is_file()):
            template = messages.OUTSIDE if path is None else messages.FILE_MISSING
            note = template(manifest=name, source=source, role=f"{key} of {carried.title}")
            notes.append(note.after("warning: "))
    return notes


def _listed(file: RelatedFile) -> str:
    """Return a note on a file that is not run."""
    about = {"source": file.source, "role": file.role, "type": file.type, "labels": labels_text(file.labels)}
    return messages.LISTED(**about, description=f" ({file.description})" if file.description else "")
