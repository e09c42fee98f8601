"""Messages have codes: unique, stable, listed in docs/messages.md, shown with -v and in JSON."""

from __future__ import annotations

import json
import pickle
import re
from pathlib import Path

import pytest

from cosim.base.errors import Fault, InputError, SimulationError
from cosim.base.messages import Template, code_of
from tests.conftest import ROOT
from tests.messages import PACKAGES, bare, message_modules, page, templates
from tests.users import cosim

MADE = Template("E-TST-001", "is {value:.1f} s; the largest is {most:g} s")


def test_a_message_keeps_code_and_fields_through_exceptions_pickles_and_prefixes() -> None:
    message = MADE(value=2.25, most=1.0)
    assert (message, message.code, message.fields["most"]) == ("is 2.2 s; the largest is 1 s", "E-TST-001", 1.0)
    assert code_of(message.after("a.yaml: ")) == code_of(pickle.loads(pickle.dumps(message))) == "E-TST-001"
    assert message.after("a.yaml: ") == "a.yaml: is 2.2 s; the largest is 1 s"
    assert str(ValueError(message)).code == "E-TST-001"  # type: ignore[attr-defined]
    assert Fault(Path("a"), 0, 0, message).code == SimulationError("a", 0.0, message).code == "E-TST-001"
    error = pickle.loads(pickle.dumps(InputError.at(Path("a"), message)))
    assert error.faults[0].code == "E-TST-001"


def test_codes_are_unique_and_well_formed_and_every_template_is_used() -> None:
    every = [(m.__name__, name, t) for m in message_modules() for name, t in templates(m).items()]
    codes = [t.code for _, _, t in every]
    assert [code for code in codes if codes.count(code) > 1 or not re.fullmatch(r"[EWN]-[A-Z]{3}-\d{3}", code)] == []
    text = "\n".join(p.read_text(encoding="utf-8") for package in PACKAGES for p in (ROOT / package).rglob("*.py"))
    assert [f"{m}.{name}" for m, name, _ in every if len(re.findall(rf"\b{name}\b", text)) < 2] == []


def test_the_page_of_messages_is_made_from_the_templates() -> None:
    told = "python -m tests.messages > docs/messages.md"
    assert (ROOT / "docs" / "messages.md").read_text(encoding="utf-8") == page(), told


@pytest.mark.parametrize("package", PACKAGES)
def test_no_text_without_a_code_becomes_a_message(package: str) -> None:
    assert list(bare(ROOT / package)) == []


def test_the_code_is_shown_with_v_and_in_json(tmp_path: Path) -> None:
    quiet, verbose = (cosim("report", tmp_path, *option) for option in ((), ("-v",)))
    assert (quiet.returncode, verbose.returncode) == (2, 2)
    assert quiet.stderr.strip().endswith("`cosim run`")
    assert verbose.stderr.strip().endswith("`cosim run` [E-CMP-006]")
    asked = cosim("compare", tmp_path / "a", tmp_path / "b", "--json")
    assert {fault["code"][:2] for fault in json.loads(asked.stdout)["faults"]} == {"E-"}
