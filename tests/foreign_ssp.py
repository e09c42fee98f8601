"""Other people's SSPs, run by `cosim`, libcosim, ecos and FMPy: `python -m tests.foreign_ssp FOLDER…`.

Whatever .ssp and SystemStructure.ssd lie in the folders are run over 200 steps, of the power of two [s] next to the
step that they say or that is taken here, or of a step that is shorter than 2 ms. Prints a table in Markdown: the
largest |a − b| / max(1, |b|) of our rows from those of the host, or why there are none.
"""

from __future__ import annotations

import math
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.errors import CosimError, InputError
from cosim.simulation.packaged import lay_out
from cosim.simulation.workflow import run
from cosim.ssp.package import open_package
from cosim.ssp.read import FmuPart, read
from tests.hosts import HOSTS, Refused, reason

STEPS = 200
READ_BY = ("libcosim", "ecos", "FMPy")


def parts_of(path: Path) -> tuple[FmuPart, ...]:
    with open_package(path) as package:
        return read(package).parts


def ours(path: Path, folder: Path) -> tuple[Any, float]:
    """Results over the first steps, and the step."""
    try:
        with tempfile.TemporaryDirectory() as laid_out:
            step = lay_out(path, Path(laid_out))[0].scenario.step
        if step >= 2.0**-9:  # whose sums are exact in hosts that add, and which is a whole number of ns
            step = 2.0 ** round(math.log2(step))
        whole = run(path, folder, [f"step={step!r}", f"duration={step * STEPS!r}", "limits.total=60 s"], report=False)
    except InputError as error:
        raise Refused(str(error.faults[0].message)) from None
    except CosimError as error:
        raise Refused(str(error)) from None
    return whole.results, step


def packed(path: Path, folder: Path) -> Path:
    """An archive, or what lies beside a description as one."""
    if path.suffix == ".ssp":
        return path
    made = folder / f"{path.parent.name}.ssp"
    with zipfile.ZipFile(made, "w") as archive:
        for file in sorted(path.parent.rglob("*")):
            if file.is_file() and file.suffix in {".ssd", ".ssv", ".ssm", ".ssb", ".fmu"}:
                name = "SystemStructure.ssd" if file == path else file.relative_to(path.parent).as_posix()
                archive.write(file, name)
    return made


def row(path: Path) -> str:
    """What becomes of one."""
    name = f"{path.parent.name}/{path.name}" if path.name == "SystemStructure.ssd" else path.name
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        try:
            results, step = ours(path, folder)
        except Refused as why:
            return f"| {name} | | refused: {reason(str(why))} | | | |"
        parts = parts_of(path)
        columns = {
            f"{'.'.join(part.place)}.{connector.get('name')}": f"{part.name}.{connector.get('name')}"
            for part in parts
            for connector in part.element.all("ssd:Connectors", "ssd:Connector")
            if connector.get("kind") == "output" and part.variables[connector.get("name")].type == "Real"
        }
        sets = any(part.element.first("ssd:ParameterBindings") for part in parts)
        with open_package(path) as package:
            text = package.structure.read_text(encoding="utf-8", errors="replace")
        outside = path if 'source="../' in text else packed(path, folder)
        job = {"ssp": str(outside), "columns": list(columns), "step": step, "steps": STEPS, "forced": step}
        job["parameters"] = "initialValues" if sets else None
        cells = []
        for host in (next(h for h in HOSTS if h.name == n) for n in READ_BY):
            try:
                assert host.rows is not None
                got = host.rows(job)
                want = np.column_stack([results[c] for c in columns.values()])
                off = np.abs(got[1:] - want[1:]) / np.maximum(1.0, np.abs(want[1:]))
                cells.append("equal" if off.max() == 0.0 else f"{off.max():.0e}")
            except Refused as why:
                cells.append(f"no: {reason(str(why))[:70]}")
        return f"| {name} | {len(parts)} | runs, {STEPS} steps of {step:.4g} s | {' | '.join(cells)} |"


def main() -> None:
    found = {p for f in sys.argv[1:] for e in ("*.ssp", "*.ssd") for p in Path(f).rglob(e)}
    print(f"| SSP | FMUs | cosim | {' | '.join(READ_BY)} |\n|---|---|---|---|---|---|")
    for path in sorted(found):
        print(row(path.resolve()), flush=True)


if __name__ == "__main__":
    main()
