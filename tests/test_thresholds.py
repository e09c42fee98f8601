"""The table of thresholds: it is that of the code, and a change reaches every module that uses one."""

from __future__ import annotations

from pathlib import Path

from cosim.refinement.decision import judgement
from cosim.refinement.search import attribution, hypotheses
from tests.blind import thresholds as suite

PAGE = Path(__file__).resolve().parent.parent / "docs" / "thresholds.md"


def test_the_page_of_thresholds_is_that_of_the_code() -> None:
    assert PAGE.read_text(encoding="utf-8") == suite.table(), (
        "python -m tests.blind.thresholds table > docs/thresholds.md"
    )


def test_every_threshold_that_decides_is_in_the_code_and_says_what_it_means() -> None:
    deciding = {(t.module, t.name): t for t in suite.thresholds() if t.decides}
    assert deciding.keys() == {(module, name) for module, names in suite.DECIDING.items() for name in names}
    assert [t.name for t in deciding.values() if not t.meaning] == []


def test_a_threshold_is_changed_wherever_it_is_used_and_put_back() -> None:
    (significant,) = (
        t for t in suite.thresholds() if (t.module, t.name) == ("refinement.decision.judgement", "SIGNIFICANT")
    )
    before = hypotheses.NOISE
    with suite.changed(significant, 2.0):
        assert judgement.SIGNIFICANT == attribution.SIGNIFICANT == 2.0 * significant.value
        assert before == hypotheses.NOISE
    assert judgement.SIGNIFICANT == attribution.SIGNIFICANT == significant.value
