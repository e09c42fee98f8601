"""The study with which a replay goes on: `cosim refine` names what the FMU lacks, `cosim fit` estimates its values."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from cosim.base.text import as_yaml
from cosim.loading.refined import ANSWER, folder_of
from cosim.residuals.compare import Comparison
from cosim.storage.folders import content_of

NEXT_STUDY = "study.yaml"
HEAD = """\
# Written by `cosim replay`. In this folder:
#   cosim check study.yaml    what can be found with these logs
#   cosim refine study.yaml   what the FMU lacks
#   cosim fit study.yaml      its parameters
"""


def lacks_something(comparison: Comparison) -> bool:
    """Return whether an error exceeds the noise."""
    return any(not (c.is_matched and c.is_explained) for c in comparison.channels)


def claimed_sensor_errors(fmu: Path) -> tuple[str, ...]:
    """Return the errors of sensors that the refine beside an FMU claims; the FMU holds none of them."""
    folder = folder_of(fmu)
    claimed = content_of(folder / ANSWER).get("effects") if folder else None
    entries = [e for e in claimed if isinstance(e, dict)] if isinstance(claimed, list) else []
    return tuple(str(e.get("name")) for e in entries if e.get("kind") == "sensor")


def next_study(folder: Path, fmu: Path, log: Path, columns: Mapping[str, str], start: Sequence[str]) -> str:
    """Return the text of a study for `folder` of an FMU and a log, to be completed by further logs.

    Args:
        columns: Name in the log → name in the FMU.
        start: Values of the replay, NAME=VALUE, which a study of `cosim refine` does not have.
    """
    lines = [HEAD, f"model: {_written(fmu, folder)}", "logs:"]
    lines.append(f"  estimation: [{_written(log, folder)}] # add more logs; co-simulation needs two")
    lines.append("  validation: [] # logs that decide nothing and prove the result")
    if columns:
        lines.append(f"columns: {as_yaml(dict(columns))}")
    if start:
        lines.append(f"# {', '.join(start)} of the replay: `cosim fit` takes such values as --start")
    return "\n".join(lines) + "\n"


def _written(path: Path, folder: Path) -> str:
    """Return a path relative to a folder, as text of YAML; absolute on another drive."""
    try:
        name = os.path.relpath(path.resolve(), folder.resolve())
    except ValueError:  # on Windows
        name = str(path.resolve())
    return as_yaml(Path(name).as_posix())
