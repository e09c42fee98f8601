"""Mixed studies: two or three effects of the catalogue of a field plant; in every fifth one such effect and a stranger.

A stranger is an effect outside the catalogue. Base parameters are off, a disturbance acts and the recorder has faults,
as in the field half. What counts as named is in `score.py`.
"""

from __future__ import annotations

from tests.blind.field_study import LARGE, PLANTS, RIGS, Study, bare, costing, hidden, names_of, stream


def draw(seed: int) -> Study:
    """Return the study of a seed, with several hidden effects."""
    plant, rng = PLANTS[seed % len(PLANTS)], stream(seed, 6)
    rig = RIGS[plant]
    strange = (seed // len(PLANTS)) % 5 == 4 and plant != "craft"  # a craft has one effect or one stranger

    def names() -> list[str]:
        if strange:
            return [str(rng.choice(sorted(rig.entries))), str(rng.choice(sorted(rig.outside)))]
        return names_of(rig, rng, int(rng.integers(2, 4)))

    return hidden(bare(seed, plant, rng), names, rng, costing(LARGE))
