"""Files that mean harm, or are merely enormous: refused at once, with a reason, and nothing written."""

from __future__ import annotations

import shutil
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from cosim.base.errors import InputError
from cosim.storage import yaml_nodes
from cosim.storage.archive import FMU, SSP, BadArchive, Contents, check_archive, unpack
from cosim.storage.yaml_nodes import Document, NotYaml
from cosim.verbs.check_verb import check as check_files

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


def directory_of(raw: bytes) -> tuple[int, int]:
    """Where the directory of an archive begins and ends."""
    size, offset = struct.unpack_from("<II", raw, raw.rfind(b"PK\x05\x06") + 12)
    return offset, offset + size


def many(path: Path) -> None:
    """Files of 60 MB each, beyond the room together; the directory says so, and it is what is believed."""
    archive(path, **{f"resources/{k}": bytes(1000) for k in range(20)})
    raw = bytearray(path.read_bytes())
    at, end = directory_of(raw)
    while at < end:
        lengths = struct.unpack_from("<HHH", raw, at + 28)
        if raw[at + 46 :].startswith(b"resources"):
            struct.pack_into("<I", raw, at + 24, 60_000_000)
        at += 46 + sum(lengths)
    path.write_bytes(raw)


def sharing(path: Path) -> None:
    """Two files of 1 MB that are the same bytes of the archive."""
    archive(path, **{"resources/z": bytes(1_000_000)})
    raw = path.read_bytes()
    begin, end = directory_of(raw)
    last = raw[raw.rfind(b"PK\x01\x02", begin, end) : end]
    count = struct.unpack_from("<H", raw, end + 10)[0] + 1
    tail = struct.pack("<4sHHHHIIH", b"PK\x05\x06", 0, 0, count, count, end - begin + len(last), begin, 0)
    path.write_bytes(raw[:end] + last.replace(b"resources/z", b"resources/y") + tail)


def overlapping(path: Path) -> None:
    """A directory that names one file's bytes thousands of times."""
    archive(path, **{"resources/z": bytes(1_000_000)})
    raw = path.read_bytes()
    end = raw.rfind(b"PK\x05\x06")
    count, size, offset = struct.unpack_from("<HII", raw, end + 10)
    directory = raw[offset : offset + size]
    last = directory[directory.rfind(b"PK\x01\x02") :]
    more = directory + last * 2000
    tail = struct.pack("<4sHHHHIIH", b"PK\x05\x06", 0, 0, count + 2000, count + 2000, len(more), offset, 0)
    path.write_bytes(raw[:offset] + more + tail)


def linked(path: Path) -> None:
    archive(path)
    with zipfile.ZipFile(path, "a") as packed:
        link = zipfile.ZipInfo("binaries/linux64/m.so")
        link.external_attr = 0o120777 << 16
        packed.writestr(link, "/etc/passwd")


def described(text: str) -> Callable[[Path], object]:
    return lambda path: archive(path, text)


ENTITIES = DESCRIPTION.replace(
    "<fmiModelDescription",
    "<!DOCTYPE x [<!ENTITY a 'aaaaaaaaaa'>"
    + "".join(f"<!ENTITY {b} '{10 * f'&{a};'}'>" for a, b in zip("abcdefgh", "bcdefghi", strict=True))
    + "]>\n<fmiModelDescription",
).replace('modelName="m"', 'modelName="&i;"')
HOSTILE: dict[str, Callable[[Path], object]] = {
    "bomb": lambda p: zeros(p, 1074),
    "many": many,
    "sharing": sharing,
    "overlapping": overlapping,
    "link": linked,
    "parent": lambda p: archive(p, **{"resources/../../../evil": b""}),
    "absolute": lambda p: archive(p, **{"/tmp/evil": b""}),
    "drive": lambda p: archive(p, **{"C:/evil": b""}),
    "entities": described(ENTITIES),
    "external": described(DESCRIPTION.replace("<fmi", '<!DOCTYPE x SYSTEM "file:///etc/passwd">\n<fmi', 1)),
    "deep": described(5000 * "<a>" + 5000 * "</a>"),
    "elements": described(f"<a>{600_000 * '<b/>'}</a>"),
    "attributes": described("<a " + " ".join(f'b{k}=""' for k in range(300)) + "/>"),
    "large": described(DESCRIPTION + 21_000_000 * " "),
    "encoding": described(DESCRIPTION.replace("UTF-8", "UF-8")),
    "cut": described(DESCRIPTION[:300]),
    "identifier": described(DESCRIPTION.replace('Identifier="m"', 'Identifier="../../m"')),
    "none": described(DESCRIPTION.replace('fmiVersion="2.0"', "")),
    "value": described(DESCRIPTION.replace('Reference="0"', 'Reference="zero"')),
    "empty": lambda p: archive(p, None),
    "text": lambda p: p.write_text("no archive"),
    "nothing": lambda p: p.write_bytes(b""),
}
INTERNALS = ("NoneType", "object has no", "Traceback", "Error:", "KeyError", "[Errno", "invalid literal", "argument of")


@pytest.mark.thorough
@pytest.mark.parametrize("kind", HOSTILE)
def test_a_hostile_archive_is_refused_with_a_reason(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "m.fmu"
    HOSTILE[kind](path)
    with pytest.raises(InputError) as caught:
        check_files(path)
    assert caught.value.exit_code == (2 if kind == "nothing" else 3)  # an empty file is no FMU at all
    assert not any(word in str(caught.value) for word in INTERNALS), caught.value
    assert list(tmp_path.iterdir()) == [path]


def test_a_sound_archive_is_unpacked_whole(tmp_path: Path) -> None:
    path = archive(tmp_path / "m.fmu", **{"resources/a b/c.txt": b"data"})
    check_archive(path)
    unpack(path, tmp_path / "out")
    assert (tmp_path / "out/resources/a b/c.txt").read_bytes() == b"data"


def test_zeros_that_are_well_packed_are_no_bomb(tmp_path: Path) -> None:
    path = zeros(tmp_path / "m.fmu", 120)
    assert path.stat().st_size < 1_200_000
    unpack(path, tmp_path / "out")
    assert (tmp_path / "out/resources/zeros").stat().st_size == 120_000_000


@pytest.mark.parametrize("kind", [FMU, SSP])
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
    raw = bytearray(path.read_bytes())
    at = raw.index(b"resources/data") + len(b"resources/data") + 8
    raw[at : at + 40] = bytes(40)
    path.write_bytes(bytes(raw))
    with pytest.raises(BadArchive, match="is damaged"):
        unpack(path, tmp_path / "out")


def test_what_breaks_a_rule_and_keeps_no_host_from_running_it_is_a_warning(tmp_path: Path) -> None:
    unlisted = DESCRIPTION.replace('<InitialUnknowns><Unknown index="1"/></InitialUnknowns>', "")
    (said,) = check_files(archive(tmp_path / "m.fmu", unlisted), load=False)
    assert "warning: ModelStructure/InitialUnknowns" in said
    without = unlisted.replace('<Outputs><Unknown index="1"/></Outputs>', "")
    assert any(
        "ModelStructure/Outputs" in line for line in check_files(archive(tmp_path / "n.fmu", without), load=False)
    )


def test_an_archive_of_very_many_files_is_refused_before_they_are_listed(tmp_path: Path) -> None:
    path = archive(tmp_path / "m.fmu")
    raw = bytearray(path.read_bytes())
    end = raw.rfind(b"PK\x05\x06")
    raw[end + 10 : end + 12] = struct.pack("<H", 65_000)
    path.write_bytes(bytes(raw))
    with pytest.raises(BadArchive, match="more than 20000 files"):
        check_archive(path)


HEADER = "time,duty_right,duty_left,tilt_right,tilt_left,psi"
ENORMOUS = {
    "line": ("a.csv", "time," + 3_000_000 * "x" + "\n0,1\n", "1:1: is not CSV"),
    "lengths": ("a.csv", HEADER + "\n" + 100_100 * "1,2\n", "6:1: has 2 cells"),
    "cells": ("a.csv", HEADER + "\n" + "".join(f"{k},1,1,1,1,x\n" for k in range(100_100)), "100095 more cells"),
    "quote": ("a.csv", 'time,"' + 200_000 * "x", "is not CSV"),
    "yaml": ("a.yaml", "name: " + 900_000 * "x", "write it as JSON"),
    "marks": ("a.yaml", "name: [" + 101_000 * "," + "]", "write it as JSON"),
    "json": ("a.json", '{"a":' * 5000, "nested too deep"),
    "bytes": ("a.yaml", 8_100_000 * "x", "8 MB, more than the 8 MB that are read"),
    "results": (
        "a.yaml",
        "name: x\nduration: 1e6\nstep: 1\ncomponents:\n  a:\n    block: reference\n    signals: {"
        + ", ".join(f"x{k}: {{}}" for k in range(2000)) + "}\n",
        "1e+06 rows of 2000 signals, 16 GB",
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.thorough) if kind == "cells" else kind for kind in ENORMOUS]
)
def test_an_enormous_file_is_refused_with_a_reason(tmp_path: Path, kind: str) -> None:
    name, text, words = ENORMOUS[kind]
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as caught:
        check_files(tmp_path / name)
    assert caught.value.exit_code == 2
    assert words in str(caught.value)
    assert len(caught.value.faults) < 10


@pytest.mark.thorough
def test_very_deep_yaml_is_refused_by_both_parsers(monkeypatch: pytest.MonkeyPatch) -> None:
    for long in (0, 10**9):
        monkeypatch.setattr(yaml_nodes, "LONG", long)
        with pytest.raises(NotYaml, match="nested too deep"):
            Document("[" * 5000 + "]" * 5000 + " #")
