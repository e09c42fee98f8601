"""Build the FMUs of this folder: `python examples/coupling/build.py [FOLDER]`."""

import shutil
import sys
import tempfile
from pathlib import Path

from cosim.fmi.building.build import build_native

HERE = Path(__file__).parent
CLASSES = {"chassis": "Chassis", "wheel": "Wheel", "battery": "Battery", "converter": "Converter"}


def build_all(folder: Path, names: tuple[str, ...] = tuple(CLASSES)) -> None:
    """Write NAME.fmu of each model into a folder."""
    for name in names:
        with tempfile.TemporaryDirectory() as place:
            (built,) = build_native(Path(place) / name, f"{HERE / name}.py:{CLASSES[name]}")
            shutil.copy(built.path, folder / f"{name}.fmu")


if __name__ == "__main__":
    build_all(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)
