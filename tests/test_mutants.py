"""The tables of `make mutants` name files that exist."""

from __future__ import annotations

from fnmatch import fnmatch

import yaml

from tests.conftest import ROOT
from tests.mutants import FILES, SUBJECTS, function_of, room_of, subject


def test_every_subject_has_a_file_of_code_and_tests() -> None:
    for pattern, tests in SUBJECTS:
        assert list(ROOT.glob(pattern)), pattern
        assert [name for name in tests.split() if not (ROOT / f"tests/test_{name}.py").is_file()] == [], pattern


def test_every_file_that_is_tried_has_a_subject_and_a_room() -> None:
    for pattern in FILES:
        files = [path.relative_to(ROOT).as_posix() for path in ROOT.glob(pattern)]
        assert files, pattern
        for file in files:
            assert subject(file), file
            assert any(fnmatch(file, f"cosim/{folder}/*") for folder in (room_of(file), "system", "master")), file


def test_every_equivalent_mutant_is_one_of_a_line_that_is_there() -> None:
    listed = yaml.safe_load((ROOT / "tests/mutants.yaml").read_text(encoding="utf-8"))
    for file, pairs in listed.items():
        lines = {line.strip() for line in (ROOT / file).read_text(encoding="utf-8").splitlines()}
        for pair in pairs:
            assert pair.keys() == {"line", "mutant", "why"}
            assert pair["line"] in lines, (file, pair["line"])
            assert pair["mutant"] not in lines


def test_a_line_is_of_the_outermost_function_around_it() -> None:
    source = (ROOT / "tests/mutants.py").read_text(encoding="utf-8").splitlines()
    first = next(k for k, line in enumerate(source, 1) if line.startswith("def operators"))
    within = next(k for k, line in enumerate(source, 1) if "def mutate(self" in line)
    assert function_of("tests/mutants.py", within + 2) == f"tests/mutants.py:{first}"
    assert function_of("tests/mutants.py", 1) == "tests/mutants.py"
