"""What a protocol's own phases tell before a bench is played, and lines of ramps that begin without thrust."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.base.errors import InputError
from cosim.verbs.check_verb import check as check_files
from plant.identification.thrust import dead_end
from tests.test_identify import PROTOCOL, short, written

# the test, its changes, and the keys at fault
CASES: dict[str, tuple[str, dict[str, Any], int]] = {
    "a step elsewhere": ("step", {"at": 5}, 1),
    "a step that is small": (
        "step", {"phases": [[0, 5, 0], [1, 5, 0], [3, 6.4, 0], [6, 6.4, 0], [6, 6.4, 4.9], [9, 6.4, 4.9]]}, 1,
    ),
    "no step": ("step", {"phases": [[0, 5, 0], [1, 5, 0], [3, 6.4, 0], [9, 6.4, 0]]}, 1),
    "a window before the step": ("step", {"window": [3.5, 5.5]}, 1),
    "a window before the thrust": ("step", {"window": [1, 2]}, 1),
    "a window before the step of thrust": ("thrust_step", {"window": [3.5, 5.5]}, 1),
    "a window that ends with the step": ("step", {"window": [5.9, 6.1]}, 1),
    "rest under thrust": ("step", {"rest": [4, 5.9]}, 1),
    "a validation without thrust": ("ground_effect", {"validation_duty": 5}, 1),
    "equal heights": ("ground_effect", {"heights": [0.68, 0.68, 0.68]}, 2),
    "heights in the ground": ("ground_effect", {"heights": [0.2, 1.25]}, 1),
    "a free height that is none": ("ground_effect", {"free_height": 0.05}, 1),
    "thrust that begins in the window": ("ground_effect", {"window": [1.8, 4]}, 1),
    "no thrust": (
        "thrust_line", {"phases": [[0, 5, 0], [5, 4, 0], [65, 5.5, 0]], "rest": [1, 1.9], "window": [5, 65]}, 1,
    ),
    "little thrust": ("thrust_line", {"phases": [[0, 5, 0], [5, 5, 0], [65, 5.85, 0]], "window": [5, 65]}, 1),
    "a motor that runs": ("moment", {"phases": [[0, 5, 0], [3, 5, 0], [13, 6, 80]]}, 1),
    "a sine without thrust": ("frequency", {"duty": 5.2}, 1),
    "a sine between rows": ("frequency", {"frequencies": [1, 4, 100]}, 1),
}  # fmt: skip


def faults_of(path: Path) -> list[str]:
    with pytest.raises(InputError) as found:
        check_files([path])
    return [str(f) for f in found.value.faults]


@pytest.mark.parametrize("case", CASES)
def test_check_refuses_phases_that_tell_nothing_once_at_their_line(case: str, tmp_path: Path) -> None:
    name, changes, count = CASES[case]
    faults = faults_of(written(tmp_path, short(**{name: changes})))
    assert len(faults) == count, faults  # however many runs are alike
    assert all("protocol.yaml:1:" in fault for fault in faults)


def test_the_phases_of_the_shipped_protocol_tell_what_they_are_for() -> None:
    assert check_files([PROTOCOL]) == []


def test_thrust_begins_where_the_kink_is_and_nowhere_for_a_line() -> None:
    rng, duty = np.random.default_rng(1), np.linspace(5.0, 7.0, 2000)
    noise = 3.0 * rng.standard_normal(duty.size)
    assert dead_end(duty, 300.0 * np.maximum(0.0, duty - 5.8) + noise) == pytest.approx(5.8, abs=0.005)
    assert dead_end(duty, 300.0 * (duty - 4.5) + noise) == pytest.approx(4.5, abs=0.01)
