"""Logs and a study of a ball on a beam: `python examples/ballbeam/make_logs.py DATA_FOLDER OUT_FOLDER`.

The recording has 1000 rows, 0.1 s apart. Two thirds are two estimation logs, the last third is sealed.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from fetch import Recording, recorded, run_make_logs, write_rows, write_study

RECORDING = Recording(
    "ballbeam.dat",
    "https://raw.githubusercontent.com/zhenwendai/RGP/be67960/datasets/system_identification/ballbeam.dat",
    "e9c48a4f7474953969d4950b4ef72558084b1995f776792ac0cbc80550e6ff42",
)
RATE = 0.1  # [s]
PARTS = {"e1.csv": (0, 333), "e2.csv": (333, 666), "v1.csv": (666, 1000)}  # rows
MODEL = Path(__file__).resolve().with_name("ballbeam.py")


def make_logs(data: Path, folder: Path) -> Path:
    """Write logs and study.yaml to `folder`; return the study."""
    folder.mkdir(parents=True, exist_ok=True)
    recording = np.loadtxt(recorded(RECORDING, data))
    for name, (first, last) in PARTS.items():
        rows = (f"{k * RATE:.1f},{angle:.7g},{x:.7g}" for k, (angle, x) in enumerate(recording[first:last]))
        write_rows(folder / name, "time,angle,position", rows)
    return write_study(folder, MODEL, "BallBeam", "inputs: interpolated\n")


if __name__ == "__main__":
    sys.exit(run_make_logs(make_logs, __doc__))
