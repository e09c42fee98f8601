"""Logs and a study of the Temperature Control Lab: `python examples/tclab/make_logs.py DATA_FOLDER OUT_FOLDER`.

Two recordings of ten minutes, steps of both heaters: one of a row a second, to learn from; one of a row each three
seconds, sealed. A command holds from its row to the next, so that two rows without a reading fit between those.
Each sensor counts from its own first readings, of the cold board: two sensors on it do not show the same.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from fetch import Recording, recorded, run_make_logs, write_rows, write_study

HOME = "https://raw.githubusercontent.com/APMonitor/arduino/f36e65a70dd7122d1829883899e40e56bf6c4279/2_Regression"
LEARNT = Recording(
    "energy_balance.txt",
    f"{HOME}/Energy_balance_MIMO/Python_minimize/data.txt",
    "10278caee2b095cca028e19acd9146157a75cdd8426e0490231de7a9def8ebdc",
)
SEALED = Recording(
    "second_order.txt",
    f"{HOME}/2nd_order_MIMO/GEKKO/data.txt",
    "60d009e96a592c3379cf2808cc06180ff517fd28b133eea9edf7038ce2d76b01",
)
LOGS = {"e1.csv": (LEARNT, 1), "v1.csv": (SEALED, 3)}  # recording, rows of the log a recorded row
COLD = 3  # rows before a heater shows
MODEL = Path(__file__).resolve().with_name("tclab.py")


def rows(recording: Path) -> np.ndarray:
    """Time [s], levels of the heaters [%], temperatures [K] above the cold board."""
    data = np.loadtxt(recording, delimiter=",", skiprows=1)[:, :5]
    data[:, 3:] -= data[:COLD, 3:].mean(axis=0)
    return data


def make_logs(data: Path, folder: Path) -> Path:
    """Write logs and study.yaml to `folder`; return the study.

    A row of a recording becomes rows a second apart, of which the first has the readings.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, (recording, each) in LOGS.items():
        lines = []
        for t, a, b, x, y in rows(recorded(recording, data)):
            lines.append(f"{t:.3f},{a:.5g},{b:.5g},{x:.3f},{y:.3f}")
            lines += [f"{t + k:.3f},{a:.5g},{b:.5g},," for k in range(1, each)]
        write_rows(folder / name, "time,heater_1,heater_2,temperature_1,temperature_2", lines)
    return write_study(folder, MODEL, "Board", estimation=["e1.csv"])


if __name__ == "__main__":
    sys.exit(run_make_logs(make_logs, __doc__))
