"""The arm and the mixed studies of the blind suite: sheet of the arm, drawn studies, and what counts as named."""

from __future__ import annotations

from tests.blind import parts


def line(truth: list[str], verdict: str, names: list[str], **more: object) -> parts.Line:
    """A line of results, as the harness writes it."""
    effects = [{"name": n} for n in names] if verdict != "ambiguous" else []
    return {
        "plant": "cart", "kind": "known", "truth": {n: {} for n in truth}, "verdict": verdict, "effects": effects,
        "rivals": names if verdict == "ambiguous" else [], "base": {}, "strangers": [], "grade": "claimed",
    } | more  # fmt: skip


def test_a_claim_names_its_parts_and_a_foreign_name_is_wrong() -> None:
    done = line(["drag", "delay"], "effect_found", ["drag", "friction"])
    assert parts.named_parts(done) == {"drag"}
    assert parts.wrong_parts(done) == {"friction"}


def test_a_part_in_one_of_few_rivals_is_named_and_no_rival_is_wrong() -> None:
    done = line(["drag", "delay"], "ambiguous", ["drag + delay", "friction + delay"])
    assert parts.named_parts(done) == {"drag", "delay"}
    assert parts.wrong_parts(done) == set()
    many = line(["drag"], "ambiguous", ["drag", "a", "b", "c"])
    assert parts.named_parts(many) == set()


def test_friction_is_due_only_where_the_yardstick_halves_an_error() -> None:
    due = line(["coulomb_1"], "unexplained", [], yardstick={"without": [2.0, 1.0], "with": [0.9, 1.0]})
    small = line(["coulomb_1"], "unexplained", [], yardstick={"without": [2.0, 1.0], "with": [1.5, 0.8]})
    assert parts.counts([due, small])["all_parts_named"] == (0, 1)
