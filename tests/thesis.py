"""Rows of docs/seed.md whose numbers come from the thesis' own scripts: `python -m tests.thesis [ROW …]` prints them.

The recordings of the thesis are lost. Where a row needs data, they are synthetic: the equations of the bench with the
thesis' final numbers (4.33, 5.46), and noise of a fixed seed where it says so.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from controller.design_model import discrete_model, measurement_matrix
from controller.loop import Loop
from controller.settings import Settings
from cosim.core.arrays import Array
from cosim.model.namespaces import arrays
from plant.bench import Bench
from plant.identification.analyses import least_degree
from plant.powertrain import assembly_moment, ground_effect

BENCH = Bench()
STEP = 0.02  # [s], Fig 4.8
MODES = (30.52, 78.67)  # [Hz], modes 1 and 2 of Table 3.3
PROPELLER = 6500.0  # [rpm], §3.3.2


class Row(NamedTuple):
    """Numbers of one row: as the thesis prints or computes it, and as it should be."""

    unit: str
    thesis: float
    ours: float
    note: str


def correction_in_the_loop() -> list[Row]:
    """D.3.5: `f = f - correction` stands inside `for i = 2:N`, so that early runs are corrected up to 19 times.

    Synthetic: twenty runs of M = m·g·l·sin α (4.10, m = 0.145 kg) on a cell that is 0.75e-4 N m low.
    """
    angle = np.radians(np.linspace(0.0, 80.0, 2251))  # t_i = 251 … t_f = 2501
    correction, count, mass = -0.75e-4, 20, 0.09  # D.3.5
    run = assembly_moment(arrays(), angle, BENCH.assembly_mass, BENCH.gravity, BENCH.assembly_arm) + correction

    def arm(moment: Array) -> float:
        basis = np.tile(mass * BENCH.gravity * np.sin(angle), count)
        return float(basis @ moment / (basis @ basis))

    f = run
    for _ in range(2, count + 1):
        f = np.concatenate((f, run))
        f = f - correction
    once = arm(np.tile(run, count) - correction)
    return [
        Row("m", -1.17e-4, arm(f), "arm l by the script as printed"),
        Row("m", -1.17e-4, once, "arm l with one subtraction, m = 0.09 kg"),
        Row("m", -1.17e-4, once * mass / BENCH.assembly_mass, "the same with m = 0.145 kg, eq 5.2"),
    ]


def overwritten_weights() -> list[Row]:
    """D.3.2: the weighted `th` of 4.27 is overwritten by the one without weights in the next line.

    Synthetic: Γ of 4.28 at the four heights, ten runs, each ratio with 0.2 % of noise, seed 1; 500 such sets.
    """
    heights, rng = np.tile([0.68, 1.25, 2.0, 2.75], 10), np.random.default_rng(1)
    gains = ground_effect(arrays(), heights, 1.0, BENCH.ground_effect_exponent)
    x, found = np.log(1.0 / (4.0 * heights)), []
    for _ in range(500):
        noisy = gains * (1.0 + 2e-3 * rng.standard_normal(heights.size))
        y = np.log((noisy - 1.0) / noisy)
        found.append([float((w * x * y).sum() / (w * x * x).sum()) for w in (np.ones_like(x), 1.0 / heights)])
    plain, weighted = np.array(found).T
    return [
        Row("1", plain[0], weighted[0], "k of one set without weights, which the script leaves, and with 1/Z̄"),
        Row("1", float(plain.std(ddof=1)), float(weighted.std(ddof=1)), "scatter of k over 500 sets"),
    ]


def script_of_test_4() -> list[Row]:
    """D.3.4: 3 gf are taken off every amplitude, phases are shifted by the first, and the step is smoothed."""
    w, tau = np.array([0.1, 10.0]), BENCH.lag
    answer = 1.0 / (1.0 + 1j * w * tau)  # 4.29
    thrust = BENCH.thrust_offset + BENCH.thrust_slope * 6.2
    thrust *= float(ground_effect(arrays(), 0.095, BENCH.propeller_radius, BENCH.ground_effect_exponent))
    size = thrust * math.sin(math.radians(10.0)) * np.abs(answer)  # [gf]

    def db(amplitudes: Array) -> float:
        return float(20.0 * np.log10(amplitudes[1] / amplitudes[0]))

    phases = np.degrees(np.angle(answer))
    shifted = phases + abs(phases[0])
    mask = np.exp(-0.5 * (np.arange(-1, 2) / 10.0) ** 2)
    mask /= mask.sum()
    smooth = float(mask @ np.exp(-STEP * np.arange(-1, 2) / tau))  # of e^(−t/τ), which stays an exponential
    return [
        Row("dB", db(size - 3.0), db(size), f"magnitude at 10 rad/s; the sine has {size[0]:.1f} gf at 0.1 rad/s"),
        Row("deg", float(shifted[1]), float(phases[1]), "phase at 10 rad/s, shifted by that at 0.1 rad/s"),
        Row("s", tau * (1.0 + math.log(smooth)), tau, "time to 1 − 1/e after a Gaussian over three rows"),
    ]


def thrust_of_test_3() -> list[Row]:
    """D.3.3: the thrust is the mean of five rows of run 5, and `delta = 6.2` where D.2.3 records 6.3 %.

    The second row is the scatter of that thrust by the battery, 1.5 % a run as in examples/bench/protocol.yaml.
    """
    low, high = (BENCH.thrust_offset + BENCH.thrust_slope * d for d in (6.2, 6.3))
    return [
        Row("gf", low, high, "thrust line at 6.2 and at 6.3 %"),
        Row("%", 1.5, 1.5 / math.sqrt(15.0), "scatter of the thrust of one run, and of the mean of fifteen"),
    ]


def horizontal_force() -> list[Row]:
    """§3.3.1: 4 N at 25°."""
    return [Row("N", 1.75, 4.0 * math.sin(math.radians(25.0)), "horizontal part of 4 N at 25°")]


def structural_modes() -> list[Row]:
    """§3.3.2: modes 1 and 2 inside the range of the propeller."""
    return [Row("rpm", PROPELLER, 60.0 * f, f"mode {k}, inside 0 to {PROPELLER:g} rpm") for k, f in enumerate(MODES, 1)]


def degree_by_rmse() -> list[Row]:
    """§4.3.1: the degree with the least RMSE against the data that were fitted is always the highest.

    Synthetic: a straight thrust line (4.20), twenty runs with 1.5 % by the battery and 5 gf of noise, seed 1.
    """
    rng, duty = np.random.default_rng(1), np.linspace(6.19, 6.56, 400)
    line = BENCH.thrust_offset + BENCH.thrust_slope * duty
    runs = [line * (1.0 + 0.015 * rng.standard_normal()) + 5.0 * rng.standard_normal(duty.size) for _ in range(20)]
    x, y = np.tile(duty - 6.0, 20), np.concatenate(runs)
    errors = {d: float(np.sqrt(np.mean((np.polyval(np.polyfit(x, y, d), x) - y) ** 2))) for d in (1, 2, 3)}
    chosen, _ = least_degree([duty] * 20, runs)
    return [Row("1", min(errors, key=lambda d: errors[d]), chosen, "degree by RMSE, and by runs that are left out")]


def initial_slope() -> list[Row]:
    """§4.3.4: τ = 1/a, a the initial slope; over the first three rows of 0.02 s an exponential is no line."""
    time = STEP * np.arange(3)
    slope = float(np.polyfit(time, 1.0 - np.exp(-time / BENCH.lag), 1)[0])
    return [Row("s", 1.0 / slope, BENCH.lag, "τ by the slope of three rows without noise, and the τ that was put in")]


def single_precision() -> list[Row]:
    """App. F: every matrix is `single`.

    Synthetic: 3000 updates of the filter's own model under tilts of ±5° for 2 s each, with the noise of 5.46, seed 1.
    """
    (single, sigma), (double, true) = (_filtered(kind, 3000) for kind in (np.float32, np.float64))
    position, _, heading, *_ = np.abs(single - double).max(axis=0)
    return [
        Row("m", float(sigma), float(true), "σ(x̂) after 3000 updates in single and in double precision"),
        Row("m", float(position), 0.0, "largest difference of x̂ over 60 s"),
        Row("rad", float(heading), 0.0, "largest difference of ψ̂ over 60 s"),
    ]


def _filtered(kind: type[np.floating], updates: int) -> tuple[Array, float]:
    """Return estimates by row and the last σ(x̂) of App. F, in one precision."""
    p, rng, truth, rows = Settings(), np.random.default_rng(1), np.zeros(5), []
    model = (*discrete_model(p), np.asarray(measurement_matrix(p, p.estimator)))
    F, G, H = (np.asarray(matrix, dtype=kind) for matrix in model)
    V, W = (np.diag(v).astype(kind) for v in (p.process_variances, p.measurement_variances))
    x, P = np.zeros(5, kind), np.zeros((5, 5), kind)
    for k, noise in enumerate(rng.standard_normal((updates, 3)) * np.sqrt(p.measurement_variances)):
        u = np.full(2, math.radians(5.0 if k % 200 < 100 else -5.0))
        truth = model[0] @ truth + model[1] @ u
        x, P = F @ x + G @ u.astype(kind), F @ P @ F.T + V
        gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + W)
        x = x + gain @ ((model[2] @ truth + noise).astype(kind) - H @ x)
        P = (np.eye(5, dtype=kind) - gain @ H) @ P
        rows.append(x)
    return np.array(rows, dtype=np.float64), math.sqrt(P[0, 0])


def noise_on_states() -> list[Row]:
    """Fig 6.1: noise is added to the state variables, and the regulator reads them; there is no observer.

    Both at rest on the linear model (5.33, 5.34), 60 s, the noise of 5.46, seed 1. Fig 6.1: noise on ψ, ψ̇ and a, and
    the true x and ẋ, which nothing on the craft measures. Ours: the filter of App. F, which knows where it starts.
    """
    p, found = Settings(), []
    F, G = discrete_model(replace(p, estimator="lagged"))
    K, H = np.array(p.gain_matrix), np.asarray(measurement_matrix(p, "appendix_f"))
    noises = np.random.default_rng(1).standard_normal((3000, 3)) * np.sqrt(p.measurement_variances)
    for observed in (False, True):
        loop, x, u, rows = Loop(p, np.zeros(5).tolist(), 0.0, 0.0), np.zeros(5), np.zeros(2), []
        for noise in noises:
            x = F @ x + G @ u
            u = np.array(loop.step(H @ x + noise, 0.0, 0.0)) if observed else -K @ (x + np.r_[0.0, 0.0, noise])
            rows.append((*u, x[0]))
        squares = np.square(rows)
        found.append((math.degrees(math.sqrt(squares[:, :2].mean())), math.sqrt(squares[:, 2].mean())))
    return [
        Row("deg", found[0][0], found[1][0], "RMS of the tilt command"),
        Row("m", found[0][1], found[1][1], "RMS of the position x"),
    ]


ROWS: dict[str, Callable[[], list[Row]]] = {
    "D.3.5": correction_in_the_loop,
    "D.3.2": overwritten_weights,
    "D.3.4": script_of_test_4,
    "D.3.3": thrust_of_test_3,
    "3.3.1": horizontal_force,
    "3.3.2": structural_modes,
    "4.3.1": degree_by_rmse,
    "4.3.4": initial_slope,
    "F": single_precision,
    "6.1": noise_on_states,
}


if __name__ == "__main__":
    for row in sys.argv[1:] or ROWS:
        for r in ROWS[row]():
            print(f"{row}: {r.note}: thesis {r.thesis:.4g}, ours {r.ours:.4g} {r.unit}")
