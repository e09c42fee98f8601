"""`cosim.read`: read the results of a verb."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from cosim.core.registry import resolve
from cosim.files.artefact import artefacts
from cosim.files.files import FilePath
from cosim.files.folders import newest_run

if TYPE_CHECKING:
    from cosim.calibration.fitted import Fitted
    from cosim.refinement.refinement import Refined
    from cosim.residuals.replay_signals import Replay
    from cosim.simulation.run_signals import Run, Signals
    from cosim.sweeps.store import Runs


def read(folder: FilePath) -> Run | Replay | Fitted | Refined | Runs | Signals:
    """Read the results of a verb from a folder, or the signals of a CSV file.

    Args:
        folder: Folder of `run`, `simulate`, `replay`, `fit`, `refine` or `sweep`, or a CSV file whose first column is
            time.

    Returns:
        The object that the verb's function returns; `Runs` of a sweep; `Signals` of a CSV file.

    Raises:
        InputError: There are no such results.
    """
    from cosim.simulation.run_signals import read_run

    path = newest_run(Path(folder))
    for artefact in artefacts():
        if artefact.reader and artefact.is_left_in(path):
            result: Run | Replay | Fitted | Refined | Runs | None = resolve(artefact.reader)(path)
            if result is not None:
                return result
    return read_run(path)
