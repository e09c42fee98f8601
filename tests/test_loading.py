"""Libraries that do not load: the text of the system's loader, what is missing, and the cure."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from cosim.core.errors import InputError
from cosim.fmi.native.compiler import compiler
from cosim.verbs.checks import check as check_files
from tests.compiled import description, pack
from tests.decay import decay_library as library


def compiled(folder: Path, source: str, *more: str) -> bytes:
    """The library of a source of C."""
    library()  # skips where there is no compiler for this platform
    (folder / "x.c").write_text(source)
    command = [*(compiler() or ()), "-shared", "-fPIC", "-o", "x.so", "x.c", *more]
    subprocess.run(command, check=True, cwd=folder)
    return (folder / "x.so").read_bytes()


def needing_another(folder: Path) -> bytes:
    """A library that needs libgfortran-of-nobody.so.3, which is gone."""
    compiled(folder, "int solve(void) { return 1; }", "-Wl,-soname,libgfortran-of-nobody.so.3")
    (folder / "x.so").rename(folder / "solve.so")
    made = compiled(folder, "int solve(void); int fmi2DoStep(void) { return solve(); }", "./solve.so")
    (folder / "solve.so").unlink()
    return made


def patched(at: int, value: int) -> Callable[[Path], bytes]:
    """The library of decay.c with one byte of its header changed."""

    def made(folder: Path) -> bytes:
        content = bytearray(library().read_bytes())
        content[at] = value
        return bytes(content)

    return made


BROKEN: dict[str, tuple[Callable[[Path], bytes], tuple[str, ...]]] = {
    "a library that it needs": (
        needing_another,
        ("libgfortran-of-nobody.so.3: cannot open shared object file", "LD_LIBRARY_PATH"),
    ),
    "a symbol that nobody has": (
        lambda folder: compiled(folder, "int nowhere(void); int f(void) { return nowhere(); }", "-Wl,-z,now"),
        ("undefined symbol: nowhere",),
    ),
    "a function of FMI": (
        lambda folder: compiled(folder, "int fmi2DoStep(void) { return 0; }"),
        ("has no function fmi2",),
    ),
    "another version of glibc": (
        lambda folder: library().read_bytes().replace(b"GLIBC_2.2.5", b"GLIBC_9.9.9"),
        ("needs glibc 9.9.9, this machine has glibc 2.",),
    ),
    "another processor": (patched(18, 183), ("is no library for this machine",)),
    "other bits": (patched(4, 1), ("is no library for this machine",)),
    "another system": (lambda folder: b"MZ" + bytes(500), ("is no library for this machine (it begins with 4d 5a",)),
    "a pointer of git-lfs": (lambda folder: b"version https://git-lfs.github.com/spec/v1\noid", ("git lfs pull",)),
    "nothing": (lambda folder: b"", ("is no library for this machine (it begins with nothing)",)),
}


def fmu_with(path: Path, library: str, content: bytes) -> Path:
    return pack(path, description("decay"), None, {f"binaries/{library}": content})


@pytest.mark.parametrize("kind", BROKEN)
def test_a_library_that_does_not_load_is_told_by_the_loader_with_the_cure(tmp_path: Path, kind: str) -> None:
    make, words = BROKEN[kind]
    if not library().read_bytes().startswith(b"\x7fELF"):
        pytest.skip("libraries are not of the format ELF here")
    with pytest.raises(InputError) as caught:
        check_files(fmu_with(tmp_path / "broken.fmu", "linux64/renamed.so", make(tmp_path)))
    assert caught.value.exit_code == 3
    told = str(caught.value)
    assert "does not load: its library renamed.so: " in told
    assert all(word in told for word in words), told
    assert "modelIdentifier" not in told  # a library of another name is no reason
    assert "cosim-" not in told  # nor is the folder of this run anybody's business
    assert told.count("\n") == 0


def test_an_fmu_for_another_system_names_the_platforms_that_it_is_for(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="win64") as caught:
        check_files(fmu_with(tmp_path / "windows.fmu", "win64/decay.dll", b"MZ"))
    assert caught.value.exit_code == 3
