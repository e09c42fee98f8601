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
TILTED = [[0, 5, 0], [1, 5, 0], [3, 6.4, 0], [6, 6.0, 0], [6, 6.4, 25], [9, 6.4, 25]]  # the duty falls until the step
CASES: dict[str, tuple[str, dict[str, Any], list[str]]] = {
    "a step elsewhere": (
        "step", {"at": 5},
        ["servo_duty has no step at 5 s; phases of two values at one time make a step; there is one at 6 s"],
    ),
    "a step that is small": (
        "step", {"phases": [[0, 5, 0], [1, 5, 0], [3, 6.4, 0], [6, 6.4, 0], [6, 6.4, 4.9], [9, 6.4, 4.9]]},
        ["servo_duty steps by 4.9° at 6 s, less than 5°; let it step by 5° at least"],
    ),
    "no step": ("step", {"phases": [[0, 5, 0], [1, 5, 0], [3, 6.4, 0], [9, 6.4, 0]]}, ["there is none"]),
    "a window before the step": ("step", {"window": [3.5, 5.5]}, ["`window` from 3.5 to 5.5 s does not hold the step"]),
    "a window before the thrust": ("step", {"window": [1, 2]}, ["does not hold the step `at` 6 s"]),
    "a window before the step of thrust": ("thrust_step", {"window": [3.5, 5.5]}, ["does not hold the step `at` 6 s"]),
    "a window that ends with the step": ("step", {"window": [5.9, 6.1]}, ["10 after it and 3 before it are needed"]),
    "a duty that moves at the step": ("step", {"phases": TILTED}, ["duty changes too about the step of servo_duty"]),
    "rest under thrust": ("step", {"rest": [4, 5.9]}, ["the phase at rest is missing: duty is 6.4 % there already"]),
    "a hold at a tilt": ("projection", {"hold": [9.5, 10]}, ["which is read upright (2.5° or less)"]),
    "a hold at another duty": (
        "projection",
        {"phases": [[0, 5, 0], [1, 5, 0], [2, 6.2, 0], [4, 6.2, 0], [5, 6.3, 0], [6, 6.3, 0], [10, 6.3, 25]],
         "window": [6, 10], "hold": [3, 4]},
        ["duty is 6.2 % in `hold` and 6.3 % in `window`"],
    ),
    "a hold while thrust comes": ("projection", {"hold": [2.1, 2.5]}, ["in the 0.57 s before, in which"]),
    "a validation without thrust": ("ground_effect", {"validation_duty": 5}, ["5 % gives no thrust"]),
    "a validation that is none": ("ground_effect", {"validation_duty": 6.3}, ["6.3 % is used by the phases already"]),
    "equal heights": ("ground_effect", {"heights": [0.68, 0.68, 0.68]}, 2 * ["0.68 is listed twice"]),
    "heights in the ground": ("ground_effect", {"heights": [0.2, 1.25]}, ["0.2 radii is too low: the ground effect"]),
    "a free height that is none": ("ground_effect", {"free_height": 0.05}, ["0.05 m is not above the heights"]),
    "thrust that changes": (
        "ground_effect", {"window": [1.8, 4]}, ["duty is 5.66 % in `window`", "the duty goes from 5 to 6.3 %"],
    ),
    "no thrust": (
        "thrust_line", {"phases": [[0, 5, 0], [5, 4, 0], [65, 5.5, 0]], "rest": [1, 1.9], "window": [5, 65]},
        ["duty is 5.5 % at most, and thrust begins above 5.77 %"],
    ),
    "little thrust": (
        "thrust_line", {"phases": [[0, 5, 0], [5, 5, 0], [65, 5.85, 0]], "window": [5, 65]},
        ["less than 0.1 % is above 5.77 %, where thrust begins"],
    ),
    "a jump before a short ramp": (
        "thrust_line", {"phases": [[0, 5, 0], [2, 5, 0], [2, 6, 0], [5, 6.5, 0], [8, 5, 0]], "window": [2.3, 5]},
        ["the duty jumps at 2 s, and `window` begins at 2.3 s, before thrust and low pass have settled"],
    ),
    "a ramp at a tilt": ("thrust_line", {"phases": [[t, d, 20] for t, d, _ in DOWN]}, ["the tilt is up to 20.0° in"]),
    "a motor that runs": ("moment", {"phases": [[0, 5, 0], [3, 5, 0], [13, 6, 80]]}, ["is read with the motor off"]),
    "a sine without thrust": ("frequency", {"duty": 5.2}, ["duty is 5.2 % at most, and thrust begins above 5.77 %"]),
    "a sine between rows": ("frequency", {"frequencies": [1, 4, 100]}, ["100 rad/s at a step of 0.02 s has less than"]),
}  # fmt: skip


def faults_of(path: Path) -> list[str]:
    with pytest.raises(InputError) as found:
        check_files([path])
    return [str(f) for f in found.value.faults]


@pytest.mark.parametrize("case", CASES)
def test_check_refuses_phases_that_tell_nothing_once_at_their_line(case: str, tmp_path: Path) -> None:
    name, changes, told = CASES[case]
    faults = faults_of(written(tmp_path, short(**{name: changes})))
    assert len(faults) == len(told), faults  # however many runs are alike
    for part, fault in zip(told, faults, strict=True):
        assert part in fault
        assert "protocol.yaml:1:" in fault


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
