"""Malicious or very large files: rejected at once, with a reason, and nothing is written."""

from __future__ import annotations

import re
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from cosim.core.errors import InputError
from cosim.files.archive import FMU_CONTENTS, SSP_CONTENTS, BadArchive, Contents, check_archive, unpack
from cosim.files.yaml_file import Document
from cosim.verbs.checks import check as check_files

DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="m" guid="{1}">
<CoSimulation modelIdentifier="m"/><ModelVariables>
<ScalarVariable name="y" valueReference="0" causality="output"><Real/></ScalarVariable>
</ModelVariables><ModelStructure><Outputs><Unknown index="1"/></Outputs>
<InitialUnknowns><Unknown index="1"/></InitialUnknowns></ModelStructure></fmiModelDescription>
"""


def archive(path: Path, description: str | None = DESCRIPTION, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        if description is not None:
            packed.writestr("modelDescription.xml", description)
        for name, data in members.items():
            packed.writestr(name, data)
    return path


def zeros(path: Path, megabytes: int, name: str = "resources/zeros") -> Path:
    """An archive with a file of zeros, packed to a thousandth of them."""
    with zipfile.ZipFile(archive(path), "a", zipfile.ZIP_DEFLATED, compresslevel=1) as packed:
        million = bytes(1_000_000)
        with packed.open(name, "w") as stream:
            for _ in range(megabytes):
                stream.write(million)
    return path


def described(text: str) -> Callable[[Path], object]:
    return lambda path: archive(path, text)


ENTITIES = DESCRIPTION.replace(
    "<fmiModelDescription",
    "<!DOCTYPE x [<!ENTITY a 'aaaaaaaaaa'>"
    + "".join(f"<!ENTITY {b} '{10 * f'&{a};'}'>" for a, b in zip("abcdefgh", "bcdefghi", strict=True))
    + "]>\n<fmiModelDescription",
).replace('modelName="m"', 'modelName="&i;"')
HOSTILE: dict[str, tuple[Callable[[Path], object], str]] = {
    "bomb": (lambda p: zeros(p, 1074), "1074 MB"),
    "parent": (lambda p: archive(p, **{"resources/../../../evil": b""}), "outside its folder"),
    "drive": (lambda p: archive(p, **{"C:/evil": b""}), "outside its folder"),
    "entities": (described(ENTITIES), "DOCTYPE"),
    "deep": (described(5000 * "<a>" + 5000 * "</a>"), "nested more than"),
    "elements": (described(f"<a>{600_000 * '<b/>'}</a>"), "more than the 500000 elements"),
    "large": (described(DESCRIPTION + 21_000_000 * " "), "21 MB; the limit is 20 MB"),
    "identifier": (described(DESCRIPTION.replace('Identifier="m"', 'Identifier="../../m"')), "../../m"),
    "empty": (lambda p: archive(p, None), "has no modelDescription.xml"),
    "nothing": (lambda p: p.write_bytes(b""), "is empty; give"),
}


@pytest.mark.thorough
@pytest.mark.parametrize("kind", HOSTILE)
def test_a_hostile_archive_is_refused_with_a_reason(tmp_path: Path, kind: str) -> None:
    make, words = HOSTILE[kind]
    path = tmp_path / "m.fmu"
    make(path)
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        check_files(path)
    assert caught.value.exit_code == (2 if kind == "nothing" else 3)  # an empty file is no FMU at all
    assert list(tmp_path.iterdir()) == [path]


def test_zeros_that_are_well_packed_are_no_bomb(tmp_path: Path) -> None:
    path = zeros(tmp_path / "m.fmu", 120)
    assert path.stat().st_size < 1_200_000
    unpack(path, tmp_path / "out")
    assert (tmp_path / "out/resources/zeros").stat().st_size == 120_000_000


@pytest.mark.parametrize("kind", [FMU_CONTENTS, SSP_CONTENTS])
def test_what_the_disk_has_no_room_for_is_refused_before_it_is_written(
    tmp_path: Path, kind: Contents, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = zeros(tmp_path / "m.fmu", 2)
    with zipfile.ZipFile(path, "a") as packed:
        packed.writestr("SystemStructure.ssd", "<a/>")
    room = shutil.disk_usage(tmp_path)._replace(free=2_100_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: room)
    (tmp_path / "out").mkdir()
    with pytest.raises(OSError, match="No space left"):
        unpack(path, tmp_path / "out", kind)
    assert not list((tmp_path / "out").iterdir())


def test_an_archive_with_a_damaged_file_is_refused(tmp_path: Path) -> None:
    path = archive(tmp_path / "m.fmu", **{"resources/data": bytes(range(256)) * 40})
    raw = path.read_bytes()
    at = raw.index(b"resources/data") + len(b"resources/data") + 8
    path.write_bytes(raw[:at] + bytes(40) + raw[at + 40 :])
    with pytest.raises(BadArchive, match="is damaged"):
        unpack(path, tmp_path / "out")


def test_an_archive_of_very_many_files_is_refused(tmp_path: Path) -> None:
    path = archive(tmp_path / "m.fmu", **{f"resources/{k}": b"" for k in range(20_000)})
    with pytest.raises(BadArchive, match="more than 20000 files"):
        check_archive(path)


ENORMOUS = {
    "line": ("a.csv", "time," + 3_000_000 * "x" + "\n0,1\n", "1:1: is not CSV"),
    "lengths": ("a.csv", "time,a,b,c\n" + 100_100 * "1,2\n", "100099 further rows"),
    "yaml": ("a.yaml", "name: " + 900_000 * "x", "write it as JSON"),
    "marks": ("a.yaml", "name: [" + 101_000 * "," + "]", "write it as JSON"),
    "json": ("a.json", '{"a":' * 5000, "nested more than"),
    "bytes": ("a.yaml", 8_100_000 * "x", "8.1 MB, more than the limit of 8 MB"),
    "results": (
        "a.yaml",
        "name: x\nduration: 1e6\nstep: 1\ncomponents:\n  a:\n    block: reference\n    signals: {"
        + ", ".join(f"x{k}: {{}}" for k in range(1200)) + "}\n",
        "1e+06 rows of 1200 signals, 9.6 GB",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", ENORMOUS)
def test_an_enormous_file_is_refused_with_a_reason(tmp_path: Path, kind: str) -> None:
    name, text, words = ENORMOUS[kind]
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        check_files(tmp_path / name)
    assert caught.value.exit_code == 2
    assert len(caught.value.faults) < 10


LONG = "# " + 30_000 * "-" + "\n"  # makes a text long enough for another parser


def test_a_long_yaml_file_is_read_as_a_short_one() -> None:
    text = """# of all kinds
a: &x {b: 1, "c d": 0o17, 'e''f': [yes, on, True, ~, null, 0x1f, 1e3, -.inf, 012, 1_000, 2020-01-01, 1:30, é]}
g: |
  two
  lines
h: {a: *x, b: 2}
? i
: >-
  folded
  text
"""
    said = []
    for document in (Document("#\n" + text), Document(LONG + text)):
        places = [document.place(where, key) for where in (("a", "e'f", 8), ("h", "b"), ("i",)) for key in (0, 1)]
        said.append((repr(document.data), places))
    assert said[0] == said[1]
    assert "'c d': 15" in said[0][0]
    assert "['yes', 'on', True, None, None, 31, 1000.0, -inf, 12, 1000" in said[0][0]
