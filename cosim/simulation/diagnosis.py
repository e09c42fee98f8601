"""What is wrong, or worth a warning, while the parts of a scenario are put together."""

from __future__ import annotations

from cosim.errors import Fault, InputError
from cosim.simulation.scenario_file import ScenarioFile

Place = tuple[str | int, ...]  # keys that lead to a part of the scenario


class Diagnosis:
    """Collects faults, those of the file's form first, and warnings, until all are reported at once."""

    def __init__(self, file: ScenarioFile) -> None:
        self.file = file
        self.found: list[Fault] = list(file.faults)
        self.warnings: list[str] = []

    def note(self, where: Place, message: str, exit_code: int = 2) -> None:
        """Note a fault at a place of the scenario."""
        self.found.append(self.file.fault(where, message, exit_code=exit_code))

    def raise_any(self) -> None:
        """InputError where there is a fault."""
        if self.found:
            raise InputError(self.found)
