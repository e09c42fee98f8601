"""Logs and a study of a pendulum: `python examples/pendulum/make_logs.py DATA_FOLDER OUT_FOLDER`.

Two recordings. A swing from a large angle, 55 s at 1 kHz, cut by its authors into six pieces: the fourth and fifth to
learn from, the last sealed. And a small swing until it comes to rest, 6 s at 10 kHz, sealed too. Of both a row each
10 ms. Each log starts at a turning point, where the rate, which is not logged, is 0.
"""

import math
import sys
from pathlib import Path

import numpy as np
import scipy.io

sys.path.append(str(Path(__file__).resolve().parents[1]))
from fetch import Recording, recorded, run_make_logs, write_rows, write_study

HOME = "https://raw.githubusercontent.com/dynamicslab/MultiArm-Pendulum/e99a7e13fe2adc8fc647321a156b6cb59a48a698"
LARGE = Recording(
    "SinglePendulumDataForParameterEstimation.mat",
    f"{HOME}/ParameterEstimation/SinglePendulum/SinglePendulumDataForParameterEstimation.mat",
    "f3b8cdda4a6e86405ec37ff32b98be76fd37806a609cba7870628c1e40377a98",
)
SMALL = Recording(
    "SingleDataFreeSwing_1_Dt_0_0001.mat",
    f"{HOME}/Datas/SinglePendulum/SingleDataFreeSwing_1_Dt_0_0001.mat",
    "5e6272350a91fb9fb99b6949bc49e3e63e21af977cc1f777310f5d8e9b0fc7e7",
)
LEARNT, SEALED = ("e1.csv", "e2.csv"), ("v1.csv", "v2.csv")
STEP = 0.01  # [s]
NEAR, HALF_PERIOD, FLAT = 0.05, 0.41, 4e-4  # [s], [s], [rad] a turning point is looked for after, within, and so near
SMALL_LASTS = 5.6  # [s] until it has come to rest
NOISE = 1e-4  # [rad] how far an arm that is taken for rigid is to be believed, see README.md
MODEL = Path(__file__).resolve().with_name("pendulum.py")


def large(recording: Path) -> list[np.ndarray]:
    """Angles [rad] of the six pieces, from where the arm hangs; the encoder counts from upright."""
    data = scipy.io.loadmat(recording)
    return [from_turn(piece[0] - math.pi, 1e-3) for part in ("Y_id", "Y_vad") for piece in data[part].ravel()]


def small(recording: Path) -> np.ndarray:
    """Angles [rad] of the small swing, likewise."""
    signal = scipy.io.loadmat(recording)["Theta1"][0, 0]["signals"][0, 0]
    return from_turn(signal["values"].ravel()[: round(SMALL_LASTS / 1e-4)] - math.pi, 1e-4)


def from_turn(angle: np.ndarray, step: float) -> np.ndarray:
    """Return a row every 10 ms from the first turning point on; `step` of the recording in s."""
    span = np.abs(angle[round(NEAR / step) : round((NEAR + HALF_PERIOD) / step)])
    turn = round(NEAR / step) + round(float(np.flatnonzero(span > span.max() - FLAT).mean()))
    return angle[turn :: round(STEP / step)]


def make_logs(data: Path, folder: Path) -> Path:
    """Write logs and study.yaml to `folder`; return the study. The cart was fixed."""
    folder.mkdir(parents=True, exist_ok=True)
    pieces = large(recorded(LARGE, data))
    swings = [*pieces[3:], small(recorded(SMALL, data))]
    for name, angle in zip((*LEARNT, *SEALED), swings, strict=True):
        rows = (f"{k * STEP:.2f},0,{a:.7f}" for k, a in enumerate(angle))
        write_rows(folder / name, "time,cart [m/s2],angle [rad]", rows)
    keys = f"noise: {{angle: {NOISE}}}\n"
    return write_study(folder, MODEL, "Pendulum", keys, estimation=LEARNT, validation=SEALED)


if __name__ == "__main__":
    sys.exit(run_make_logs(make_logs, __doc__))
