"""Kinds of files of other tools, with advice."""

from __future__ import annotations

from cosim.files.artefact import Artefact

XML = r"(<\?xml[^>]*>\s*)?"
ARTEFACTS = (
    Artefact(
        "a page for a browser",
        "a browser opens it; `cosim report FOLDER` makes that of a run again",
        text=r"(?i)<!doctype html|<html",
    ),
    Artefact(
        "a picture",
        "a browser opens it; `cosim graph SCENARIO` draws one",
        heads=(b"\x89PNG", b"\xff\xd8\xff", b"GIF8"),
        text=rf"(?is){XML}(<!--.*?-->\s*|<!doctype[^>]*>\s*)*<svg\b",
    ),
    Artefact(
        "a notebook",
        "Jupyter opens it; in it, `import cosim`",
        keys=(frozenset({"nbformat"}),),
        endings=(".ipynb",),
    ),
    Artefact(
        "a file of matrices",
        "save it again with -v7, or write its columns as CSV, `time` first, and `cosim check` checks that",
        heads=(b"MATLAB 7.3",),  # earlier versions and HDF5 are read as tables
        endings=(".mat",),
    ),
    Artefact(
        "a workbook",
        "save the sheet as CSV, `time` first, and `cosim check` checks that",
        heads=(b"\xd0\xcf\x11\xe0",),
        member="xl/",
    ),
    Artefact("an archive without an FMU", "unpack it; `cosim info` lists an FMU that is in it", member="*"),
    Artefact(
        "a compiled library",
        "libraries are parts of FMUs; `cosim info` lists the content of an FMU",
        heads=(b"\x7fELF", b"MZ", b"\xcf\xfa\xed\xfe"),
    ),
    Artefact(
        "a JSON schema",
        "an editor reads it; `cosim schema` prints it",
        keys=(frozenset({"$schema", "properties"}), frozenset({"$schema", "$defs"})),
    ),
    Artefact(
        "a pointer of Git LFS",
        "`git lfs pull` fetches the file itself; then `cosim check` checks it",
        heads=(b"version https://git-lfs.",),
    ),
    Artefact("XML", "`cosim info` lists what the FMU has that it is of", text=r"<(\?xml|[A-Za-z][\w:]*[ >])"),
    Artefact("a PDF", "no command reads it; `cosim --help` lists what each takes", heads=(b"%PDF-",)),
)
