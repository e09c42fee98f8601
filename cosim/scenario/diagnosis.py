"""Faults and warnings collected while a scenario is assembled."""

from __future__ import annotations

from cosim.base.errors import Fault, InputError, refuse
from cosim.scenario.scenario_file import ScenarioFile
from cosim.storage.yaml_file import MOST_FAULTS

LONGEST = 2000  # of a message [characters]
Place = tuple[str | int, ...]  # keys of a part of the scenario


class Diagnosis:
    """Collected faults and warnings, reported all at once; faults of form come first."""

    def __init__(self, file: ScenarioFile) -> None:
        self.file = file
        self.faults: list[Fault] = list(file.faults)
        self.warnings: list[str] = list(file.warnings)

    def note(self, where: Place, message: str, exit_code: int = 2) -> None:
        """Note a fault at a place of the scenario; raise InputError at the limit of faults."""
        if len(message) > LONGEST:
            message = f"{message[: LONGEST - 1]}…"
        self.faults.append(self.file.fault(where, message, exit_code=exit_code))
        if len(self.faults) >= MOST_FAULTS:
            raise InputError([*self.faults, Fault(self.file.path, 0, 0, f"the first {MOST_FAULTS} faults are shown")])

    def raise_any(self) -> None:
        """Raise InputError if any fault was noted."""
        refuse(self.faults)
