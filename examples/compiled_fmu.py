"""FMUs of examples: an own C file of equations and an own modelDescription.xml, compiled and packed.

The FMU holds neither the source nor the symbols: `python examples/compiled_fmu.py examples/drive/fmu drive.fmu`.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from cosim.fmi.native.compiler import POSITION, NoCompiler, fmi_headers, required_compiler, this_platform

OPTIONS = ("-std=c99", "-O2", "-w", "-s", "-ffp-contract=off")


def compiled_fmu(source: Path, fmu: Path) -> Path:
    """Write the FMU of a folder with modelDescription.xml and equations.c; return its path.

    Raises:
        NoCompiler: There is no C compiler, or FMI knows no name for this machine.
    """
    platform = this_platform()
    if platform is None:
        raise NoCompiler("FMI has no name for this machine")
    description = (source / "modelDescription.xml").read_text(encoding="utf-8")
    name = re.findall(r'modelIdentifier="(\w+)"', description)[0]
    fmu.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "library"
        paths = [f"-I{fmi_headers()}", f"-I{Path(__file__).parent}", "-o", str(library), str(source / "equations.c")]
        subprocess.run([*required_compiler(), "-shared", *POSITION, *OPTIONS, *paths, "-lm"], check=True)
        with zipfile.ZipFile(fmu, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("modelDescription.xml", description)
            archive.write(library, f"binaries/{platform.folder(2)}/{name}{platform.suffix}")
    return fmu


if __name__ == "__main__":
    try:
        print(compiled_fmu(Path(sys.argv[1]), Path(sys.argv[2])))
    except NoCompiler as error:
        sys.exit(str(error))
