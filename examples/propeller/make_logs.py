"""A table and a study of a propeller: `python examples/propeller/make_logs.py DATA_FOLDER OUT_FOLDER`.

The UIUC data base gives the thrust coefficient at each speed. The thrust that was measured is made of it again, with
the definition by which it became a coefficient; of the air density only the standard one is known.
"""

import argparse
import csv
import os
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))
from fetch import Recording, RecordingError, recorded

RECORDING = Recording(
    "apcsf_10x4.7_static_kt0835.txt",
    "https://m-selig.ae.illinois.edu/props/volume-1/data/apcsf_10x4.7_static_kt0835.txt",
    "20519deb7e9678b0674005c38fdb8a23e916800bf5fc1b5714612f3f4c13d9a0",
    # all of this propeller in one table; its rows with an advance ratio J of 0 are the same
    {"apcsf_10x4.7_all.csv": "8491595c28bbbdfc8172ed345578e2fde31709cd7c8ce8610292ee7431301182"},
)
DIAMETER, DENSITY = 0.254, 1.225  # [m], [kg/m3]
MODEL = Path(__file__).resolve().with_name("propeller.py")


def rows(recording: Path) -> list[tuple[float, float]]:
    """Speed [rpm] and thrust coefficient of every static row."""
    text = recording.read_text(encoding="utf-8").splitlines()
    if recording.suffix == ".csv":
        return [(float(row["N"]), float(row["CT"])) for row in csv.DictReader(text) if float(row["J"]) == 0.0]
    return [(float(speed), float(coefficient)) for speed, coefficient, _ in map(str.split, text[1:])]


def write_table(path: Path, table: list[tuple[float, float]]) -> None:
    """One CSV without time: each row stands for itself."""
    unit = DENSITY * DIAMETER**4 / 3600.0
    lines = (f"{speed:.0f},{coefficient * unit * speed * speed:.5f}" for speed, coefficient in table)
    path.write_text("\n".join(["speed [rpm],thrust [N]", *lines]) + "\n", encoding="utf-8")


def write_study(folder: Path) -> Path:
    """study.yaml beside the table; it names the model by its file."""
    path = folder / "study.yaml"
    model = Path(os.path.relpath(MODEL, folder.resolve())).as_posix()
    path.write_text(f"model: {model}:Propeller\nlogs:\n  estimation: [static.csv]\n", encoding="utf-8")
    return path


def make_logs(data: Path, folder: Path) -> Path:
    """Table and study.yaml in `folder`; returns the study."""
    folder.mkdir(parents=True, exist_ok=True)
    write_table(folder / "static.csv", rows(recorded(RECORDING, data)))
    return write_study(folder)


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description="A table and a study of a propeller")
    arguments.add_argument("data", type=Path, help=f"folder of {RECORDING.name}; downloaded into it if it is not there")
    arguments.add_argument("out", type=Path, help="folder for static.csv and study.yaml")
    given = arguments.parse_args()
    try:
        print(make_logs(given.data, given.out))
    except RecordingError as error:
        sys.exit(str(error))
