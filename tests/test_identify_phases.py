"""What a protocol's own phases tell before a bench is played, and lines of ramps that begin without thrust."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.base.errors import InputError
from cosim.verbs.check_verb import check as check_files
from plant.identification.thrust_line import dead_end
from tests.bench_runs import play_plain, read_protocol, simulate_seeds
from tests.test_identify import PROTOCOL, short, written

RAMP = [[0, 5, 0], [2, 5, 0], [17, 6.5, 0], [20, 5, 0]]  # the motor begins to turn at 5.77 %
DOWN = [[0, 5, 0], [2, 5, 0], [2, 6, 0], [17, 7, 0], [20, 5, 0]]
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
    "a validation that is none": ("ground_effect", {"validation_duty": 6.3}, 1),
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


def test_one_step_that_is_too_long_is_one_fault(tmp_path: Path) -> None:
    for step, told in ((0.7, "0.05 s or less"), (1e-6, "1000000 are allowed")):
        (fault,) = faults_of(written(tmp_path, short() | {"step": step}))
        assert told in fault


def test_every_fault_of_phases_model_and_loads_is_told_at_once(tmp_path: Path) -> None:
    content = short(step={"at": 5}, ground_effect={"free_height": 0.05}) | {"model": "drive"}
    faults = "\n".join(faults_of(written(tmp_path, content)))
    for part in ("no step at 5 s", "0.05 m is not above", "no such model: drive"):
        assert part in faults
    content["cells"]["z"]["loads"] = [285, 0, 85, 85, 200]
    assert "85 is hung twice; hang each load once" in "\n".join(faults_of(written(tmp_path, content)))


def test_the_phases_of_the_shipped_protocol_tell_what_they_are_for() -> None:
    assert check_files([PROTOCOL]) == []


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("phases", "window"),
    [(RAMP, [2.2, 16.98]), (RAMP, [5, 19.9]), (DOWN, [5, 19.9])],
    ids=["from below", "up and down from below", "up, out of the cell's range, and down"],
)
def test_a_ramp_over_the_dead_end_or_the_cell_s_end_gives_the_line_of_its_thrust(
    tmp_path: Path, phases: Any, window: Any
) -> None:
    content = short(thrust_line={"phases": phases, "rest": [1, 1.9], "window": window, "repetitions": 6})
    protocol = read_protocol(written(tmp_path, content))
    (outcome,) = simulate_seeds(protocol, play_plain(protocol.bench), [1])
    for e in outcome.estimates.values():
        assert abs(e.value - e.truth) <= 0.75 * (e.high - e.low), (e.name, e.value)  # one and a half half-widths
        assert e.high - e.low < 0.12 * abs(e.truth)
    told = [w for w in outcome.warnings if "readings are without thrust, which begins at 5.7" in w]
    assert told
    assert outcome.warnings == told  # and nothing that bends


def test_thrust_begins_where_the_kink_is_and_nowhere_for_a_line() -> None:
    rng, duty = np.random.default_rng(1), np.linspace(5.0, 7.0, 2000)
    noise = 3.0 * rng.standard_normal(duty.size)
    assert dead_end(duty, 300.0 * np.maximum(0.0, duty - 5.8) + noise) == pytest.approx(5.8, abs=0.005)
    assert dead_end(duty, 300.0 * (duty - 4.5) + noise) == pytest.approx(4.5, abs=0.01)
