"""Two FMUs of 20 000 inputs and outputs each, all connected: `python -m tests.many` prints what check and run take."""

from __future__ import annotations

import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from cosim.fmi.native.compiler import compiler

MANY = 20_000
HERE = Path(__file__).parent
HEAD = '<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription fmiVersion="2.0" modelName="many" guid="g">'
WAY = '<CoSimulation modelIdentifier="many" canHandleVariableCommunicationStepSize="true"/>'


def many(folder: Path) -> Path:
    """Return the FMU and a scenario with two instances of it."""
    kinds = (("u", "input", ' start="0"', 0), ("y", "output", "", MANY))
    variables = "".join(
        f'<ScalarVariable name="{name}{k}" valueReference="{first + k}" causality="{kind}">'
        f"<Real{start}/></ScalarVariable>"
        for name, kind, start, first in kinds
        for k in range(MANY)
    )
    outputs = "".join(f'<Unknown index="{MANY + k + 1}" dependencies=""/>' for k in range(MANY))
    structure = f"<Outputs>{outputs}</Outputs><InitialUnknowns>{outputs}</InitialUnknowns>"
    body = f"<ModelVariables>{variables}</ModelVariables><ModelStructure>{structure}</ModelStructure>"
    library = folder / "many.so"
    flags = ["-O1", "-shared", "-fPIC"]
    subprocess.run([*(compiler() or ["cc"]), *flags, "-o", str(library), str(HERE / "many.c")], check=True)
    with zipfile.ZipFile(folder / "many.fmu", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", f"{HEAD}{WAY}{body}</fmiModelDescription>")
        archive.write(library, f"binaries/{'darwin' if platform.system() == 'Darwin' else 'linux'}64/many.so")
    wires = "".join(f"  - {{from: a.y{k}, to: b.u{k}}}\n" for k in range(MANY))
    path = folder / "many.yaml"
    path.write_text(
        "name: many\nduration: 1\nstep: 0.1\n"
        f"components: {{a: {{fmu: many.fmu}}, b: {{fmu: many.fmu}}}}\nconnections:\n{wires}"
    )
    return path


def main() -> None:
    """Print processor time [s] of all processes and the largest size [MB] as a line of JSON."""
    measured: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        path = many(Path(folder))
        environment = {**os.environ, "PYTHONPATH": str(HERE.parent)}
        for what in (["check", "--no-load"], ["check"], ["run", "--out", f"{folder}/out"]):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            command = [sys.executable, "-P", "-m", "cosim", *what, str(path)]
            done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
            if done.returncode:
                sys.exit(done.stderr)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            measured[" ".join(what[:2] if what[0] == "check" else what[:1])] = [
                round(seconds, 2),
                after.ru_maxrss // 1024,
            ]
    print(json.dumps(measured))


if __name__ == "__main__":
    main()
