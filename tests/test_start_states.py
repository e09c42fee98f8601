"""Start states of free runs of an FMU: which variables set them, and their estimates from a log."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from cosim.estimation import fit as fitting
from cosim.estimation.posing import build_problem, halve_log, with_equations_trusted
from cosim.estimation.problem import Problem
from cosim.estimation.start_states import with_likely_starts
from cosim.kernel.kernel import Begin, simulate_all
from cosim.kernel.propagation import lasting, propagations
from cosim.kernel.remote_kernel import RemoteLibraryKernel
from cosim.refinement.decision.evidence import Replays
from cosim.refinement.search.missing import unknown_inputs
from cosim.refinement.study import Study, read_study
from cosim.refinement.workflow import _build_problem
from cosim.residuals.drive import Drive, log_of_fmu
from cosim.subject.candidates import Free
from cosim.subject.fmu_subject import FmuSubject
from tests.blind.fmu_build import build
from tests.logs import write_log

ROWS, STEP = 400, 0.01
NOISE = {"motor_phi": 0.01, "motor_w": 0.3, "load_phi": 0.01}
BEGIN = {"motor.phi": 0.4, "motor.w": 14.0, "load.phi": 0.3, "load.w": 15.0}


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    """The study of a turning drive; the speed of its load is not measured."""
    folder = tmp_path_factory.mktemp("drive")
    fmu = build(folder / "drive.fmu", "drive", ways=("co_simulation",))
    time = STEP * np.arange(ROWS)
    torque = np.sign(np.sin(3.0 * time))
    raw = write_log(folder / "raw.csv", {"time": time, "torque": torque, "motor.phi": time})
    with Drive(log_of_fmu(raw, fmu), fmu) as drive:
        table = dict(zip(drive.outputs, drive.run(0, ROWS - 1, BEGIN).T, strict=True))
    rng = np.random.default_rng(4)
    levels = {name.replace("_", ".", 1): sigma for name, sigma in NOISE.items()}
    readings = {name: y + levels[name] * rng.standard_normal(ROWS) for name, y in table.items()}
    write_log(folder / "e1.csv", {"time": time, "torque": torque, **readings})
    path = folder / "study.yaml"
    path.write_text(json.dumps({"model": fmu.name, "logs": {"estimation": ["e1.csv"], "validation": []}}))
    return read_study(path)


@pytest.fixture(scope="module")
def problem(study: Study) -> Problem:
    return with_likely_starts(build_problem(study.subject, study.logs, noise=NOISE))


@pytest.mark.thorough
def test_every_state_that_shows_in_an_output_is_a_start_state(problem: Problem) -> None:
    names = [problem.layout.states[k] for k in problem.layout.start_places]
    assert names == ["start.motor_phi", "start.motor_w", "start.load_phi", "start.load_w"]


def test_start_states_are_those_of_the_log(problem: Problem) -> None:
    estimates = problem.x0[0][problem.layout.start_places]
    assert np.abs(estimates - [*BEGIN.values()]).max() < 0.4  # of 15 rad/s, with a noise of 0.3 rad/s in each row


def test_a_free_run_leaves_no_more_than_the_noise(problem: Problem) -> None:
    noise = problem.at(problem.noise.smallest)
    errors, variances = problem.innovations(problem.values, noise, 0)
    assert np.nanmean(errors[100:] ** 2 / variances[100:]) == pytest.approx(1.0, abs=0.2)


def test_a_stated_noise_that_is_far_too_small_limits_no_fit(study: Study) -> None:
    content = study.content.model_copy(update={"noise": {name: 0.1 * sigma for name, sigma in NOISE.items()}})
    limits = _build_problem(replace(study, content=content)).limits
    highest = dict(zip(NOISE, np.exp(0.5 * limits.high[-2 * len(NOISE) : -len(NOISE)]), strict=True))
    assert {name for name, sigma in NOISE.items() if highest[name] > sigma} == {*NOISE}


def test_predictions_are_parts_of_the_free_run(study: Study, problem: Problem) -> None:
    undisturbed = replace(fitting.initial_fit(problem), noise=problem.at(problem.noise.smallest))
    residuals = Replays(problem, study.subject.horizon, undisturbed, 0).residuals(problem.values)
    sizes = np.sqrt(np.nanmean(residuals**2, axis=(0, 1)))
    assert sizes == pytest.approx([*NOISE.values()], rel=0.3)


def test_half_a_log_keeps_the_whole_run(problem: Problem) -> None:
    halves = halve_log(problem)
    assert [len(data.u) for data in halves.logs] == [ROWS, ROWS]
    assert [int(np.isfinite(data.y[:, 0]).sum()) for data in halves.logs] == [ROWS // 2, ROWS // 2]


def test_an_unknown_input_counts_relative_to_the_rate_of_its_output(problem: Problem) -> None:
    at, units = fitting.initial_fit(problem), {"motor_phi": "rad", "motor_w": "rad/s", "load_phi": "rad"}
    shares = unknown_inputs(problem, at, [True] * 3, units)
    low, high = np.percentile(np.diff(problem.own_run(0).outputs[:, 1]) / STEP, (2.5, 97.5))
    assert shares["motor_w"] == pytest.approx(np.exp(0.5 * at.noise.power[1]) / (high - low), rel=0.2)


def test_deviations_of_outputs_go_on_as_those_by_start_states_do() -> None:
    """Two coupled outputs with three start states each obey one matrix, also in other units."""
    matrix = np.array([[1.0, 0.01], [-0.2, 0.95]])
    slopes = np.empty((200, 2, 3))
    slopes[0] = [[1.0, 0.0, 0.3], [0.0, 50.0, -2.0]]
    for k in range(1, 200):
        slopes[k] = matrix @ slopes[k - 1]
    run = np.random.default_rng(3).standard_normal((200, 2))  # it does not matter where a linear machine is
    found = propagations(slopes, run)
    assert found.shape == (200, 2, 4)
    assert (found == found[0]).all()
    now, before = np.hsplit(found[0], 2)
    assert now == pytest.approx(matrix, abs=1e-9)
    assert (before == 0.0).all()
    assert (propagations(np.empty((200, 2, 0)), run) == 0.0).all()
    growing = propagations(1.05 ** np.arange(200)[:, None, None] * slopes, run)
    assert np.abs(np.linalg.eigvals(growing[0, :, :2])).max() == pytest.approx(1.0)


def test_the_row_before_stands_for_hidden_velocities() -> None:
    """A pendulum on a spring shows its two positions only; its deviations swing as the positions do."""
    rates = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [-4.0, 1.0, -0.1, 0.0], [2.0, -30.0, 0.0, -0.2]])
    whole, states = expm(0.02 * rates), np.eye(4)
    positions = np.array([(states := whole @ states)[:2] for _ in range(400)])
    matrix, *_ = propagations(positions, positions[:, :, 0])
    went = [*positions[:2]]
    for _ in range(300):
        went.append(matrix @ np.vstack([went[-1], went[-2]]))
    assert np.array(went)[300] == pytest.approx(positions[300], abs=1e-6)


@pytest.mark.parametrize("missed", [0, 1])
def test_deviations_go_on_as_the_place_of_the_run_demands(missed: int) -> None:
    """A pendulum swings over ±1.2 rad; a deviation of 1 mrad follows from row to row, also one that nobody tried.

    Args:
        missed: Rows at the begin without a response, as after a pulse.
    """

    def swing(angle: float, rate: float) -> np.ndarray:
        state, angles, h = np.array([angle, rate]), [], 0.02 / 20
        for _ in range(1500):
            angles.append(state[0])
            for _ in range(20):
                half = state + 0.5 * h * np.array([state[1], -20.0 * np.sin(state[0]) - 0.05 * state[1]])
                state = state + h * np.array([half[1], -20.0 * np.sin(half[0]) - 0.05 * half[1]])
        return np.array(angles)

    run = swing(1.2, 0.0)
    tried = [(swing(1.2 + 1e-3, 0.0) - run) / 1e-3, (swing(1.2, 1e-3) - run) / 1e-3]
    found = propagations(np.stack(tried, axis=-1)[missed:, None, :], run[:, None])
    other = swing(1.2 + 1e-3, 4e-3) - run
    pairs = np.column_stack([other[1:-1], other[:-2]])
    errors = [
        float(np.std(other[2:] - np.sum(of * pairs, axis=1))) for of in (found[1:-1, 0], found[:, 0].mean(axis=0))
    ]
    assert errors[0] < 0.1 * errors[1]
    both = np.concatenate([lasting(found), np.broadcast_to(np.eye(1, 2), (len(run), 1, 2))], axis=1)
    assert np.abs(np.linalg.eigvals(both)).max() < 1.0 + 1e-9  # nothing grows without end in any row


def test_deviations_that_fade_away_stay_so_wherever_the_run_is() -> None:
    """Two tanks lose a deviation in a tenth of the run: what it shows there must not let another one grow later."""
    step, rows, parts = 1.0, 1000, 5
    pumped = 0.5 + 0.4 * np.repeat(np.random.default_rng(1).uniform(-1.0, 1.0, (rows // 50, 2)), 50, axis=0)

    def levels(begin: tuple[float, float]) -> np.ndarray:
        level, course = np.array(begin), []
        for pump in pumped:
            course.append(level)
            for _ in range(parts):
                between, out = np.sqrt(np.abs(level[0] - level[1]) + 1e-3), np.sqrt(level[1])
                between *= np.sign(level[0] - level[1])
                level = level + step / parts * np.array([0.02 * pump[0] - 0.02 * between, 0.02 * (between - out)])
                level = np.maximum(level + step / parts * np.array([0.0, 0.02 * pump[1]]), 1e-3)
        return np.array(course)

    run = levels((0.8, 0.5))
    tried = [(levels((0.8 + 1e-4, 0.5)) - run) / 1e-4, (levels((0.8, 0.5 + 1e-4)) - run) / 1e-4]
    found = propagations(np.stack(tried, axis=-1), run)
    both = np.concatenate([found, np.broadcast_to(np.eye(2, 4), (rows, 2, 4))], axis=1)
    growth = np.abs(np.linalg.eigvals(both)).max(axis=1)
    assert growth[rows // 2 :].max() < 1.1


def test_a_deviation_of_both_angles_stays_and_a_twist_fades(problem: Problem) -> None:
    """Nothing holds the shaft; its spring and damper take a twist out."""
    (matrix, *others) = problem.kernel.propagation(problem.logs[0], problem.x0[0])  # type: ignore[attr-defined]
    assert (np.array(others) == matrix).all()  # linear
    assert [bool(column.any()) for column in matrix[:, 3:].T] == [False, False, True]  # the load's speed is hidden
    both = np.vstack([matrix, np.eye(3, 6)])
    turned, twisted = (np.linalg.matrix_power(both, 300) @ [1.0, 0.0, end, 1.0, 0.0, end] for end in (1.0, -1.0))
    assert turned[[0, 2]] == pytest.approx(1.0, abs=0.01)
    assert abs(twisted[0] - twisted[2]) < 0.01


def test_pulses_of_inputs_tell_the_same_without_start_values(study: Study, problem: Problem) -> None:
    subject = study.subject
    assert isinstance(subject, FmuSubject)
    log = log_of_fmu(study.logs[0].path, subject.structure.fmu)
    bare = FmuSubject.of_fmu(replace(subject.structure, starts=()), [log])
    posed = build_problem(bare, study.logs, noise=NOISE)
    assert not posed.layout.start_places
    known, pulsed = (p.kernel.propagation(p.logs[0], p.x0[0]) for p in (problem, posed))  # type: ignore[attr-defined]
    assert pulsed == pytest.approx(known, rel=0.01, abs=1e-3 * np.abs(known).max())


def test_a_reading_late_by_half_a_row_is_that_of_a_run_with_half_the_step(problem: Problem) -> None:
    values = {**problem.values, "latency_at_motor_phi.value": 2.5 * STEP}
    data, p = problem.data(problem.values, 0), problem.numbers(problem.of_log(problem.values, 0))
    u, substeps = np.repeat(data.u, 2, axis=0)[:-1], max(1, data.substeps // 2)
    half = replace(data, u=u, step=0.5 * STEP, substeps=substeps, late=None, lags=None)
    run = problem.kernel.simulate(half, p, problem.x0[0], np.zeros(problem.layout.memory)).outputs
    own = run[:, 0]
    bends = np.abs(own[1::2] - 0.5 * (own[:-2:2] + own[2::2]))
    assert bends.max() > 1e-6 * np.ptp(own)
    y = run[::2].copy()
    y[:3, 0], y[3:, 0] = own[0], own[1::2][:-2]
    posed = replace(problem, logs=[replace(problem.logs[0], y=y)])
    errors, _ = posed.innovations(values, problem.at(problem.noise.smallest), 0)
    assert np.nanmax(np.abs(errors[10:-5, 0])) < 1e-9 * np.ptp(own)


def test_slopes_that_serve_two_steps_lead_to_the_same_values(
    study: Study, problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = with_equations_trusted(study.subject, problem)  # noise that is not there has many likely levels
    free = [Free("motor_b", 0.0, 1.0, 0.002, (0.02, 0.002)), Free("load_J", 0.001, 1.0, 0.003, (0.03, 0.003))]
    start = {**problem.values, "motor_b": 0.024, "load_J": 0.033}
    noise, results = problem.plain, []
    for kernel in (RemoteLibraryKernel, type(None)):
        monkeypatch.setattr(fitting, "RemoteLibraryKernel", kernel)
        results.append(fitting.fit(problem, free, start, noise, sensing=False))
    assert results[0].objective == pytest.approx(results[1].objective, abs=0.5)
    for name in ("motor_b", "load_J"):
        assert abs(results[0].values[name] - results[1].values[name]) < 0.3 * results[1].sigma(name)


def test_simulations_in_one_call_are_those_of_single_calls(problem: Problem) -> None:
    data, memory = problem.logs[0], np.zeros(problem.layout.memory)
    p, x0 = problem.numbers(problem.values), problem.x0[0]
    begins: list[Begin] = [(data.rows(0, rows), p, x0, memory, None, 0) for rows in (50, 100)]
    for begin, run in zip(begins, simulate_all(problem.kernel, begins), strict=True):
        np.testing.assert_array_equal(run.outputs, problem.kernel.simulate(*begin[:5], first=0).outputs)
