"""Write the FMUs of this example, with sources and without libraries: `python examples/clocks/build.py [FOLDER]`."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
NAMES = ("tank", "controller", "monitor")


def build(folder: Path) -> list[Path]:
    """Write all FMUs into a folder; `cosim run --compile` compiles their sources."""
    made = []
    for name in NAMES:
        made.append(folder / f"{name}.fmu")
        with zipfile.ZipFile(made[-1], "w") as archive:
            archive.write(HERE / name / "modelDescription.xml", "modelDescription.xml")
            archive.write(HERE / name / f"{name}.c", f"sources/{name}.c")
            archive.write(HERE / "rest.h", "sources/rest.h")
    return made


if __name__ == "__main__":
    for path in build(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE):
        print(path)
