"""Inputs of the corpus: FMUs, logs, models and wrong files, made without the packages under test."""

from __future__ import annotations

import hashlib
import math
import os
import platform
import shutil
import subprocess
import tempfile
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import yaml

SOURCES = Path(__file__).parent / "inputs"
FMU_SOURCES = SOURCES / "fmus"  # of tests, too
FIXED_DATE = (2020, 1, 1, 0, 0, 0)
# FMU → source, options of the compiler, further members; its description is NAME.xml, of another FMU where stated
DEEDS = {"crashes": "segfault", "hangs": "hang", "fails": "error", "ends": "end", "leaves": "exit"}
FMUS: Mapping[str, tuple[str, tuple[str, ...], Mapping[str, str]]] = {
    **{name: (name, (), {}) for name in ("bounce1", "decay", "typed2", "typed3", "instants")},
    "clocked": ("instants", (), {}),
    "scheduled": ("instants", (), {}),
    "slider2cs": ("slider", (), {"resources/follow": ""}),
    **{name: ("slider", (), {}) for name in ("slider2me", "slider3cs", "slider3me")},
    **{
        name: ("coupled", (f"-DLAW={law}",), {})
        for law, name in enumerate(("linear", "loop_a", "loop_b", "square", "chassis", "wheel"))
    },
    "deeds": ("deeds", (), {"resources/deed.txt": "none none 1\n"}),
    **{name: ("deeds", (), {"resources/deed.txt": f"DoStep {deed} 5\n"}) for name, deed in DEEDS.items()},
}


def make_inputs(place: Path) -> Path:
    """Return the folder of the inputs, made once for each content of their sources."""
    files = [Path(__file__), *sorted(path for path in SOURCES.rglob("*") if path.is_file())]
    key = hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:12]
    folder = place / f"inputs-{key}"
    if not folder.is_dir():
        place.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(dir=place))
        write_fmus(draft)
        write_logs(draft)
        write_wrong(draft)
        for path in SOURCES.glob("*.*"):
            if path.name != "wrong.yaml":
                shutil.copy(path, draft)
        draft.rename(folder)
    return folder


# -- FMUs -----------------------------------------------------------------------------------------------------


def write_fmus(folder: Path) -> None:
    """Compile the FMUs of C and pack them."""
    if platform.system() != "Linux" or platform.machine() != "x86_64":
        raise SystemExit("the corpus needs Linux on x86_64 and a C compiler")
    for name, (source, options, members) in FMUS.items():
        text = (FMU_SOURCES / f"{'deeds' if name in DEEDS else name}.xml").read_text(encoding="utf-8")
        pack(folder / f"{name}.fmu", text, library(source, options), members)
    text = (FMU_SOURCES / "decay.xml").read_text(encoding="utf-8")
    code = (FMU_SOURCES / "decay.c").read_text(encoding="utf-8")
    pack(folder / "uncompiled.fmu", text, None, {"sources/decay.c": code})


def library(source: str, options: tuple[str, ...]) -> bytes:
    """Return the compiled library of a source."""
    with tempfile.TemporaryDirectory() as place:
        made = Path(place) / "library.so"
        flags = ["-O1", "-w", "-shared", "-fPIC", "-Wl,--build-id=none", *options]
        path = FMU_SOURCES / f"{source}.c"
        subprocess.run([os.environ.get("CC", "cc"), *flags, "-o", str(made), str(path), "-lm", "-ldl"], check=True)
        return made.read_bytes()


def pack(path: Path, text: str, binary: bytes | None, members: Mapping[str, str]) -> None:
    """Write an FMU with a fixed date, so that its hash is the same on both sides and in each run."""
    root = ElementTree.fromstring(text)
    names = [root.get("modelIdentifier"), *(element.get("modelIdentifier") for element in root)]
    name = next(name for name in names if name)
    place = "x86_64-linux" if root.get("fmiVersion", "").startswith("3") else "linux64"
    content: dict[str, str | bytes] = {"modelDescription.xml": text, **members}
    if binary is not None:
        content[f"binaries/{place}/{name}.so"] = binary
    with zipfile.ZipFile(path, "w") as archive:
        for member, data in content.items():
            archive.writestr(zipfile.ZipInfo(member, FIXED_DATE), data)


# -- logs -----------------------------------------------------------------------------------------------------


def write_log(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write a log."""
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(columns), *(",".join(f"{value:.9g}" for value in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_logs(folder: Path) -> None:
    """Write logs of known truth: a sliding mass, as its FMU has it and with dry friction, and a DC motor."""
    for number, name in enumerate(("slide_a", "slide_b", "slide_c")):
        write_log(folder / f"{name}.csv", sliding_log(number, dry=0.0))
    for number, name in enumerate(("dry_a", "dry_b", "dry_c")):
        write_log(folder / f"{name}.csv", sliding_log(10 + number, dry=0.25))
    for number, name in enumerate(("late_a", "late_b", "late_c")):
        write_log(folder / f"{name}.csv", sliding_log(20 + number, dry=0.0, delay=4))
    for kind, dry, load in (("motor", 0.0, 0.0), ("rubbing", 0.01, 0.0), ("odd", 0.0, 0.02)):
        for number, name in enumerate("abc"):
            write_log(folder / f"{kind}_{name}.csv", motor_log(30 + number, dry, load))


def sliding_log(seed: int, *, dry: float, delay: int = 0) -> dict[str, np.ndarray]:
    """Return a log of v' = (gain/mass)·force − damping·v − dry·tanh(v/0.01), 20 s at 20 Hz, in steps of 0.5 ms."""
    rng, rows, step, parts = np.random.default_rng(seed), 401, 0.05, 100
    force = np.repeat(rng.uniform(-1.0, 1.0, rows // 20 + 1), 20)[:rows]
    acting = np.concatenate([np.zeros(delay), force])[:rows]
    position, velocity = np.zeros(rows), np.zeros(rows)
    position[0], velocity[0] = 0.3, -0.4
    for k in range(rows - 1):
        x, v = position[k], velocity[k]
        for _ in range(parts):
            a = 2.0 / 1.6 * acting[k] - 0.8 * v - dry * math.tanh(v / 0.01)
            x, v = x + step / parts * (v + 0.5 * step / parts * a), v + step / parts * a
        position[k + 1], velocity[k + 1] = x, v
    return {
        "time": step * np.arange(rows),
        "force": force,
        "position": position + 2e-3 * rng.standard_normal(rows),
        "velocity": velocity + 1e-2 * rng.standard_normal(rows),
    }


def motor_log(seed: int, dry: float, load: float) -> dict[str, np.ndarray]:
    """Return a log of the motor of model.py with dry friction and a load that follows a sine of time, 8 s at 50 Hz."""
    rng, rows, step, parts = np.random.default_rng(seed), 401, 0.02, 200
    voltage = np.repeat(rng.uniform(-12.0, 12.0, rows // 50 + 1), 50)[:rows]
    current, speed = np.zeros(rows), np.zeros(rows)
    for k in range(rows - 1):
        i, w, h = current[k], speed[k], step / parts
        for part in range(parts):
            t = k * step + part * h
            torque = 0.05 * i - 1e-4 * w - dry * math.tanh(w / 2.0) - load * math.sin(3.0 * t)
            i, w = i + h * (voltage[k] - 1.2 * i - 0.05 * w) / 2.04e-3, w + h * torque / 2e-4
        current[k + 1], speed[k + 1] = i, w
    return {
        "time": step * np.arange(rows),
        "voltage": voltage,
        "current": current + 1e-2 * rng.standard_normal(rows),
        "speed": speed + 1e-1 * rng.standard_normal(rows),
    }


# -- wrong files ----------------------------------------------------------------------------------------------


def write_wrong(folder: Path) -> None:
    """Write the wrong files of `wrong.yaml`, and the FMUs with a fault."""
    place = folder / "wrong"
    place.mkdir()
    for name, text in yaml.safe_load((SOURCES / "wrong.yaml").read_text(encoding="utf-8")).items():
        (place / name).write_text(text, encoding="utf-8")
    (place / "binary.csv").write_bytes(bytes(range(256)))
    (place / "empty.fmu").write_bytes(b"")
    (place / "text.fmu").write_text("this is no archive")
    text = (FMU_SOURCES / "decay.xml").read_text(encoding="utf-8")
    slides, binary = (FMU_SOURCES / "slider2cs.xml").read_text(encoding="utf-8"), library("slider", ())
    with zipfile.ZipFile(place / "undescribed.fmu", "w") as archive:
        archive.writestr("readme.txt", "nothing")
    pack(place / "no_library.fmu", text, None, {})
    pack(place / "no_functions.fmu", text, library("nothing", ()), {})
    pack(place / "version.fmu", text.replace('fmiVersion="2.0"', 'fmiVersion="9.0"'), None, {})
    for name, old, new in (
        ("no_guid", ' guid="g"', ""),
        ("twice", 'name="velocity"', 'name="position"'),
        ("no_number", 'start="1.0"', 'start="one"'),
        ("reference", 'valueReference="2"', 'valueReference="-2"'),
    ):
        pack(place / f"{name}.fmu", slides.replace(old, new), binary, {})
    with zipfile.ZipFile(place / "cut.fmu", "w") as archive:
        archive.writestr("modelDescription.xml", slides[: len(slides) // 2])
