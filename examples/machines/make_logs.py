"""FMUs, logs and studies of three measured machines: `python examples/machines/make_logs.py DATA_FOLDER OUT_FOLDER`.

Each machine has a folder with its FMU, two logs, a third one that is sealed, and a study.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from fetch import Recording, recorded, run_make_logs, write_rows, write_study

LAMP = Recording(
    "heating_system.dat",
    "https://raw.githubusercontent.com/robotsorcerer/FARNN/9cfb82f2b42a53a604dba66d0eab23243a9a21ae/data/heating_system.dat",
    "3bfbe8424719830870b153067eeff40ebff3afb0204c150ed7103b5d6c1908bc",
)
COPIES = "https://raw.githubusercontent.com/Rafa7046/Non_Linear_Identification/e5c9b006b0a2ec1650bc018a5fb38d2f4363d4c7/src/data"
TANKS = Recording(
    "tanque.csv", f"{COPIES}/tanque.csv", "ef2388ed822f3aef4aa80d6b0f2b466dd80b361786b3eafc7a2957c31ea323a7"
)
EXCHANGER = Recording(
    "exchanger.csv", f"{COPIES}/exchanger.csv", "3dfbb1e1c2f789a3593b460373c5c0a649647ab5548478ed0992c68d5b2c5f34"
)
MODELS = Path(__file__).resolve().with_name("machines.py")


def machines(data: Path) -> dict[str, tuple[float, str, str, list[np.ndarray]]]:
    """Return class → step [s], names of input and output, and the rows (input, output) of e1, e2 and v1."""
    lamp = np.loadtxt(recorded(LAMP, data))[:, 1:]
    tanks = np.genfromtxt(recorded(TANKS, data), delimiter=",", skip_header=1, max_rows=1024)
    exchanger = np.genfromtxt(recorded(EXCHANGER, data), delimiter=",", skip_header=1)[:, 1:]
    return {
        "Lamp": (2.0, "voltage", "temperature", [lamp[:400], lamp[400:600], lamp[600:]]),
        "Tanks": (4.0, "pump", "lower", [tanks[:512, ::2][:, :2], tanks[512:, ::2][:, :2], tanks[:, [1, 3]]]),
        "Exchanger": (1.0, "flow", "outlet", [exchanger[:1300], exchanger[1300:2600], exchanger[2600:]]),
    }


def make_logs(data: Path, folder: Path) -> list[Path]:
    """Write a folder of each machine to `folder`; return their studies."""
    studies = []
    for model, (step, of, shown, parts) in machines(data).items():
        place = folder / model.lower()
        command = [sys.executable, "-m", "cosim", "build", "--native", "--model", f"{MODELS}:{model}"]
        subprocess.run([*command, "--out", str(place), "--quiet"], check=True)
        for name, table in zip(("e1.csv", "e2.csv", "v1.csv"), parts, strict=True):
            rows = (f"{k * step:g},{u:.8g},{y:.8g}" for k, (u, y) in enumerate(table.tolist()))
            write_rows(place / name, f"time,{of},{shown}", rows)
        studies.append(write_study(place, place.resolve() / "plant-native.fmu", keys="inputs: held\ntolerance: 30%\n"))
    return studies


if __name__ == "__main__":
    sys.exit(run_make_logs(make_logs, __doc__))
