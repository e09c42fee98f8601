"""Kinds of files of other tools, with advice for messages."""

from __future__ import annotations

from cosim.files.artefact import Artefact

XML = r"(<\?xml[^>]*>\s*)?"
ARTEFACTS = (
    Artefact(
        "a page for a browser",
        "open it in a browser; `cosim report FOLDER` writes the report of a run again",
        text=r"(?i)<!doctype html|<html",
    ),
    Artefact(
        "a picture",
        "open it in a browser; `cosim graph SCENARIO` draws one",
        heads=(b"\x89PNG", b"\xff\xd8\xff", b"GIF8"),
        text=rf"(?is){XML}(<!--.*?-->\s*|<!doctype[^>]*>\s*)*<svg\b",
    ),
    Artefact(
        "a notebook",
        "open it in Jupyter",
        keys=(frozenset({"nbformat"}),),
        endings=(".ipynb",),
    ),
    Artefact(
        "a file of matrices",
        "save it with -v7, or write its columns as CSV with `time` first; then run `cosim check`",
        heads=(b"MATLAB 7.3",),  # earlier versions and HDF5 are read as tables
        endings=(".mat",),
    ),
    Artefact(
        "a workbook",
        "save the sheet as CSV with `time` first; then run `cosim check`",
        heads=(b"\xd0\xcf\x11\xe0",),
        member="xl/",
    ),
    Artefact("an archive without an FMU", "unpack it; `cosim info` describes an FMU", member="*"),
    Artefact(
        "a compiled library",
        "libraries are parts of FMUs; give the FMU",
        heads=(b"\x7fELF", b"MZ", b"\xcf\xfa\xed\xfe"),
    ),
    Artefact(
        "a JSON schema",
        "editors use it; `cosim schema` prints it",
        keys=(frozenset({"$schema", "properties"}), frozenset({"$schema", "$defs"})),
    ),
    Artefact(
        "a pointer of Git LFS",
        "run `git lfs pull` to fetch the file, then `cosim check`",
        heads=(b"version https://git-lfs.",),
    ),
    Artefact(
        "XML", "give the FMU that contains it; `cosim info` describes an FMU", text=r"<(\?xml|[A-Za-z][\w:]*[ >])"
    ),
    Artefact("a PDF", "no command reads it; `cosim --help` lists the commands and their files", heads=(b"%PDF-",)),
)
