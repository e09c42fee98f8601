"""Logs and a study of the Silverbox: `python examples/silverbox/make_logs.py DATA_FOLDER OUT_FOLDER`.

The recording is one of 131 072 rows, 10⁷/2¹⁴ a second: noise of growing size, the arrow, then ten odd random
multisines. To learn from: 16 000 rows of the multisines. Sealed: the whole arrow.
"""

import csv
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))
from compiled_fmu import compiled_fmu
from fetch import Recording, recorded, run_make_logs, write_rows, write_study

RECORDING = Recording(
    "SNLS80mV.csv",
    "https://raw.githubusercontent.com/forgi86/pytorch-ident/f00d79ff8c6cb96d094d9ea1c079d4dcbf9a67e0"
    "/examples/statespace/silverbox/SilverboxFiles/SNLS80mV.csv",
    "ae62d5a91230c10f76e6dd02c8a4fac3c9d4d8a95fbf50e87cb0c4885003e0f1",
    {"snls80mv.csv": "6eedc11a22ae874747d76d72fbdc99a3a9286ad0c54c921b9c5101fd953bb0cc"},  # without quotes
)
STEP = 2**14 / 1e7  # [s]
LEARNT, SEALED = ["multisine.csv"], ["arrow.csv"]
INPUTS = "inputs: interpolated\n"
PARTS = {"multisine.csv": slice(40_700, 56_700), "arrow.csv": slice(0, 40_500)}
MODEL = Path(__file__).resolve().with_name("silverbox.py")


def rows(recording: Path) -> list[tuple[str, str]]:
    """Input and output [V] of every row, as recorded."""
    with recording.open(encoding="utf-8", newline="") as stream:
        table = csv.DictReader(stream)
        return [(row["V1"], row["V2"]) for row in table]


def write_fmu_study(folder: Path) -> Path:
    """Write silverbox.fmu, which is compiled here, and fmu.yaml, its study."""
    fmu = compiled_fmu(Path(__file__).with_name("fmu"), folder.resolve() / "silverbox.fmu")
    keys = f"{INPUTS}noise: {{V2: 0.5 mV}}\ntolerance: {{frequency: 5%, damping: 20%}}\n"
    return write_study(folder, fmu, keys=keys, estimation=LEARNT, validation=SEALED, name="fmu.yaml")


def make_logs(data: Path, folder: Path) -> Path:
    """Write logs and study.yaml to `folder`; return the study."""
    folder.mkdir(parents=True, exist_ok=True)
    recording = rows(recorded(RECORDING, data))
    for name, part in PARTS.items():
        lines = (f"{k * STEP:.7f},{u},{y}" for k, (u, y) in enumerate(recording[part]))
        write_rows(folder / name, "time,V1 [V],V2 [V]", lines)
    return write_study(folder, MODEL, "Silverbox", INPUTS, estimation=LEARNT, validation=SEALED)


if __name__ == "__main__":
    sys.exit(run_make_logs(make_logs, __doc__, write_fmu_study))
