"""Logs and a study of a hydraulic actuator: `python examples/actuator/make_logs.py DATA_FOLDER OUT_FOLDER`.

The recording has 1024 rows. The first half is two estimation logs, the second half is sealed, as is usual. The file
states no time between rows; it counts as 0.1 s.
"""

import sys
from pathlib import Path

import scipy.io

sys.path.append(str(Path(__file__).resolve().parents[1]))
from fetch import Recording, recorded, run_make_logs, write_rows, write_study

RECORDING = Recording(
    "actuator.mat",
    "https://raw.githubusercontent.com/zhenwendai/RGP/be67960/datasets/system_identification/actuator.mat",
    "35d1f95176afd856eb4fe0e2f87e3dff39657db8e6fcf7c531078c8f4eb571e4",
)
RATE = 0.1  # [s]
PARTS = {"e1.csv": slice(0, 256), "e2.csv": slice(256, 512), "v1.csv": slice(512, 1024)}  # rows
MODEL = Path(__file__).resolve().with_name("actuator.py")


def make_logs(data: Path, folder: Path) -> Path:
    """Write logs and study.yaml to `folder`; return the study."""
    folder.mkdir(parents=True, exist_ok=True)
    recording = scipy.io.loadmat(recorded(RECORDING, data))
    for name, part in PARTS.items():
        pairs = zip(recording["u"].ravel()[part], recording["p"].ravel()[part], strict=True)
        rows = (f"{k * RATE:.1f},{u:.9g},{p:.9g}" for k, (u, p) in enumerate(pairs))
        write_rows(folder / name, "time,valve,pressure", rows)
    return write_study(folder, MODEL, "Actuator", "inputs: interpolated\n")


if __name__ == "__main__":
    sys.exit(run_make_logs(make_logs, __doc__))
