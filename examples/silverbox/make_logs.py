"""Logs and a study of the Silverbox: `python examples/silverbox/make_logs.py DATA_FOLDER OUT_FOLDER`.

The recording is one of 131 072 rows, 10⁷/2¹⁴ a second: noise of growing size, the arrow, then ten odd random
multisines. To learn from: 16 000 rows of the multisines. Sealed: the whole arrow.
"""

import argparse
import csv
import os
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))
from compiled_fmu import compiled_fmu
from fetch import Recording, RecordingError, recorded

RECORDING = Recording(
    "SNLS80mV.csv",
    "https://raw.githubusercontent.com/forgi86/pytorch-ident/f00d79ff8c6cb96d094d9ea1c079d4dcbf9a67e0"
    "/examples/statespace/silverbox/SilverboxFiles/SNLS80mV.csv",
    "ae62d5a91230c10f76e6dd02c8a4fac3c9d4d8a95fbf50e87cb0c4885003e0f1",
    {"snls80mv.csv": "6eedc11a22ae874747d76d72fbdc99a3a9286ad0c54c921b9c5101fd953bb0cc"},  # without quotes
)
STEP = 2**14 / 1e7  # [s]
PARTS = {"multisine.csv": slice(40_700, 56_700), "arrow.csv": slice(0, 40_500)}
MODEL = Path(__file__).resolve().with_name("silverbox.py")


def rows(recording: Path) -> list[tuple[str, str]]:
    """Input and output [V] of every row, as recorded."""
    with recording.open(encoding="utf-8", newline="") as stream:
        table = csv.DictReader(stream)
        return [(row["V1"], row["V2"]) for row in table]


def write_log(path: Path, part: list[tuple[str, str]]) -> None:
    """Write a log that begins at 0 s."""
    lines = (f"{k * STEP:.7f},{u},{y}" for k, (u, y) in enumerate(part))
    path.write_text("\n".join(["time,V1 [V],V2 [V]", *lines]) + "\n", encoding="utf-8")


def write_study(folder: Path) -> Path:
    """study.yaml beside the logs; it names the model by its file."""
    path = folder / "study.yaml"
    model = Path(os.path.relpath(MODEL, folder.resolve())).as_posix()
    path.write_text(
        f"model: {model}:Silverbox\ninputs: interpolated\nlogs:\n"
        "  estimation: [multisine.csv]\n  validation: [arrow.csv]\n",
        encoding="utf-8",
    )
    return path


def write_fmu_study(folder: Path) -> Path:
    """silverbox.fmu, which is compiled here, and fmu.yaml, its study."""
    path = folder / "fmu.yaml"
    compiled_fmu(Path(__file__).with_name("fmu"), folder / "silverbox.fmu")
    path.write_text(
        "model: silverbox.fmu\ninputs: interpolated\nnoise: {V2: 0.5 mV}\n"
        "tolerance: {frequency: 5%, damping: 20%}\n"
        "logs:\n  estimation: [multisine.csv]\n  validation: [arrow.csv]\n",
        encoding="utf-8",
    )
    return path


def make_logs(data: Path, folder: Path) -> Path:
    """Write logs and study.yaml to `folder`; return the study."""
    folder.mkdir(parents=True, exist_ok=True)
    recording = rows(recorded(RECORDING, data))
    for name, part in PARTS.items():
        write_log(folder / name, recording[part])
    return write_study(folder)


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description="Logs and a study of the Silverbox")
    arguments.add_argument("data", type=Path, help=f"folder of {RECORDING.name}; downloaded into it if it is not there")
    arguments.add_argument("out", type=Path, help="folder for the logs and study.yaml")
    arguments.add_argument("--fmu", action="store_true", help="write the FMU of the circuit and its study, too")
    given = arguments.parse_args()
    try:
        print(make_logs(given.data, given.out))
        if given.fmu:
            print(write_fmu_study(given.out))
    except RecordingError as error:
        sys.exit(str(error))
