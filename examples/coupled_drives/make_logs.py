"""Logs, FMU and study of coupled electric drives: `python examples/coupled_drives/make_logs.py DATA_FOLDER OUT_FOLDER`.

One record of 500 rows, 20 ms apart: the first 340 are the estimation log, the others are sealed.
"""

import sys
from pathlib import Path

import scipy.io

sys.path.append(str(Path(__file__).resolve().parents[1]))
from compiled_fmu import compiled_fmu
from fetch import Recording, recorded, run_make_logs, write_rows, write_study

RECORDING = Recording(
    "drive.mat",
    "https://raw.githubusercontent.com/zhenwendai/RGP/be67960/datasets/system_identification/drive.mat",
    "47d0825678d854d8a1bbcfb0ad1188026b853f69beb2067ea00cfd88d13dc4ca",
)
STEP = 0.02  # [s]
PARTS = {"e1.csv": slice(0, 340), "v1.csv": slice(340, 500)}


def make_logs(data: Path, folder: Path) -> Path:
    """Write logs, FMU and study.yaml to `folder`; return the study."""
    compiled_fmu(Path(__file__).with_name("fmu"), folder / "coupled_drives.fmu")
    record = scipy.io.loadmat(recorded(RECORDING, data))
    for name, part in PARTS.items():
        pairs = zip(record["u1"].ravel()[part], record["z1"].ravel()[part], strict=True)
        rows = (f"{k * STEP:.2f},{u:g},{z:.9g}" for k, (u, z) in enumerate(pairs))
        write_rows(folder / name, "time,voltage [V],speed", rows)
    keys = "noise: {speed: 0.01}\ntolerance: 2%\nhorizon: free run\n"
    return write_study(folder, folder.resolve() / "coupled_drives.fmu", keys=keys, estimation=["e1.csv"])


if __name__ == "__main__":
    sys.exit(run_make_logs(make_logs, __doc__))
