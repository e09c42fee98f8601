"""A planned input keeps its limits for every rival, otherwise it is not a success."""

from __future__ import annotations

from pathlib import Path

import pytest

from cosim.core.errors import CriterionMissed
from cosim.experiment.excite import excite
from cosim.verbs.measured import excite_command

DRIVE = f"{Path(__file__).parent.parent / 'examples' / 'drive' / 'drive.py'}:Drive"
RIVALS = ["force_offset", "coulomb_friction"]


def test_an_input_is_made_smaller_until_the_limits_hold_if_a_rival_is_true(tmp_path: Path) -> None:
    found = excite(DRIVE, tmp_path, RIVALS, limits=["force=60", "position=60 mm"], duration=5.0, experiments=4)
    assert found.excess <= 1.0
    assert max(trial.excess(found.question.limits) for trial in found.rivals.values()) == found.excess


def test_an_input_that_cannot_keep_its_limits_ends_with_5_and_leaves_its_files(tmp_path: Path) -> None:
    given = {"text": DRIVE, "folder": tmp_path / "out", "against": RIVALS, "force": False}
    with pytest.raises(CriterionMissed) as error:  # an offset pushes the drive away without any input
        excite_command(**given, limits=["force=60", "position=20 mm"], duration=5.0, experiments=4)
    assert error.value.exit_code == 5
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"excitation.csv", "excitation.yaml", "report.html"}
