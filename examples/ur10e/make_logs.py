"""Logs and a study of the elbow of a UR10e: `python examples/ur10e/make_logs.py DATA_FOLDER OUT_FOLDER`.

The recording is one of 6109 rows, 65 s long, of the elbow moved alone. Two thirds to learn from, the last sealed.
"""

import csv
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))
from fetch import Recording, recorded, run_make_logs, write_rows, write_study

RECORDING = Recording(
    "ur-20_01_22-joint_3.csv",
    "https://raw.githubusercontent.com/shamilmamedov/dynamic_calibration/11af40e/dataset_ur10e/jointwise_motion"
    "/ur-20_01_22-joint_3.csv",
    "a012487f8bedac5d6baf86c17fe4cbbf2b8f12a31070974da5867cf927e3a0a7",
)
JOINT = 3
PARTS = {"e1.csv": (0.5, 22.0), "e2.csv": (22.0, 43.0), "v1.csv": (43.0, 65.0)}  # [s]
MODEL = Path(__file__).resolve().with_name("elbow.py")


def rows(recording: Path) -> list[tuple[float, float, float, float]]:
    """Time [s], current [A], angle [rad] and rate [rad/s] of every row, as recorded."""
    with recording.open(encoding="utf-8", newline="") as stream:
        table = [[float(cell) for cell in line[:19]] for line in csv.reader(stream)]
    begin = table[0][0]
    return [(line[0] - begin, line[12 + JOINT], line[JOINT], line[6 + JOINT]) for line in table]


def make_logs(data: Path, folder: Path) -> Path:
    """Write logs and study.yaml to `folder`; return the study."""
    folder.mkdir(parents=True, exist_ok=True)
    recording = rows(recorded(RECORDING, data))
    for name, (first, last) in PARTS.items():
        lines = (f"{t - first:.4f},{i},{q},{w}" for t, i, q, w in recording if first <= t < last)
        write_rows(folder / name, "time,current,angle,rate", lines)
    return write_study(folder, MODEL, "Elbow")


if __name__ == "__main__":
    sys.exit(run_make_logs(make_logs, __doc__))
