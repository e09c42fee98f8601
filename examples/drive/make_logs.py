"""Logs and a study from the EMPS recordings: `python examples/drive/make_logs.py DATA_FOLDER OUT_FOLDER`.

The recordings (1 kHz) become logs at 200 Hz. Row k holds the encoder at t_k as it was read, and the mean of the five
commands that acted from t_k to t_k+1: the impulse over the step is exactly that of the recording, and what the
position loses by it is at most h²/8 times a jump of the acceleration (9 µm at the largest pulse, 3 m/s²).
"""

import sys
from pathlib import Path

import numpy as np
import scipy.io

sys.path.append(str(Path(__file__).resolve().parents[1]))
from compiled_fmu import compiled_fmu
from fetch import run_make_logs, write_rows, write_study

RECORDINGS = {"e1.csv": "DATA_EMPS.mat", "v1.csv": "DATA_EMPS_PULSES.mat"}
EVERY = 5  # recorded samples a row
MODEL = Path(__file__).resolve().with_name("drive.py")


def rows(recording: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time [s], motor force [N] held from row to row, position [m]."""
    data = scipy.io.loadmat(recording)
    force = float(data["gtau"].item()) * data["vir"].ravel()
    count = force.size // EVERY
    time = np.arange(count) * EVERY * 1e-3
    return time, force[: count * EVERY].reshape(count, EVERY).mean(axis=1), data["qm"].ravel()[: count * EVERY : EVERY]


def write_log(path: Path, time: np.ndarray, force: np.ndarray, position: np.ndarray) -> None:
    """Write a log."""
    lines = (f"{t:.3f},{u:.6g},{x:.9f}" for t, u, x in zip(time, force, position, strict=True))
    write_rows(path, "time,force [N],position [m]", lines)


def write_fmu_study(folder: Path) -> Path:
    """Write drive.fmu, which is compiled here, and fmu.yaml, its study."""
    fmu = compiled_fmu(Path(__file__).with_name("fmu"), folder.resolve() / "drive.fmu")
    keys = "horizon: free run\nnoise: {position: 0.1 mm}\nstart_noise: {velocity: 0.1 mm/s}\n"
    return write_study(folder, fmu, keys=keys, estimation=["e1.csv"], name="fmu.yaml")


def make_logs(data: Path, folder: Path) -> Path:
    """Write logs and study.yaml to `folder`; return the study."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, recording in RECORDINGS.items():
        write_log(folder / name, *rows(data / recording))
    return write_study(folder, MODEL, "Drive", estimation=["e1.csv"])


if __name__ == "__main__":
    sys.exit(run_make_logs(make_logs, __doc__, write_fmu_study))
