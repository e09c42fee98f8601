"""Logs and a study from the EMPS recordings: `python examples/drive/make_logs.py DATA_FOLDER OUT_FOLDER`.

The recordings (1 kHz) become logs at 200 Hz. Row k holds the encoder at t_k as it was read, and the mean of the five
commands that acted from t_k to t_k+1: the impulse over the step is exactly that of the recording, and what the
position loses by it is at most h²/8 times a jump of the acceleration (9 µm at the largest pulse, 3 m/s²).
"""

import argparse
import os
import sys
from pathlib import Path

import numpy as np
import scipy.io

sys.path.append(str(Path(__file__).resolve().parents[1]))
from compiled_fmu import compiled_fmu

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
    """One CSV."""
    lines = (f"{t:.3f},{u:.6g},{x:.9f}" for t, u, x in zip(time, force, position, strict=True))
    path.write_text("\n".join(["time,force [N],position [m]", *lines]) + "\n", encoding="utf-8")


def write_study(folder: Path, estimation: list[str], validation: list[str]) -> Path:
    """study.yaml beside the logs; it names the model by its file."""
    path = folder / "study.yaml"
    model = Path(os.path.relpath(MODEL, folder.resolve())).as_posix()
    path.write_text(
        f"model: {model}:Drive\nlogs:\n"
        f"  estimation: [{', '.join(estimation)}]\n  validation: [{', '.join(validation)}]\n",
        encoding="utf-8",
    )
    return path


def write_fmu_study(folder: Path) -> Path:
    """drive.fmu, which is compiled here, and fmu.yaml, its study."""
    path = folder / "fmu.yaml"
    compiled_fmu(Path(__file__).with_name("fmu"), folder / "drive.fmu")
    path.write_text(
        "model: drive.fmu\nhorizon: free run\nnoise: {position: 0.1 mm}\nstart_noise: {velocity: 0.1 mm/s}\n"
        "logs:\n  estimation: [e1.csv]\n  validation: [v1.csv]\n",
        encoding="utf-8",
    )
    return path


def make_logs(data: Path, folder: Path) -> Path:
    """Write logs and study.yaml to `folder`; return the study."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, recording in RECORDINGS.items():
        write_log(folder / name, *rows(data / recording))
    return write_study(folder, ["e1.csv"], ["v1.csv"])


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description="Logs and a study from the EMPS recordings")
    arguments.add_argument("data", type=Path, help="folder of DATA_EMPS.mat and DATA_EMPS_PULSES.mat")
    arguments.add_argument("out", type=Path, help="folder for e1.csv, v1.csv and study.yaml")
    arguments.add_argument("--fmu", action="store_true", help="write the FMU of the drive and its study, too")
    given = arguments.parse_args()
    print(make_logs(given.data, given.out))
    if given.fmu:
        print(write_fmu_study(given.out))
