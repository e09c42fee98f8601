"""Imitation of an effect by another effect in the field half, in the nats of `field_cost`.

python -m tests.blind.field_visibility [PLANT …]     best imitation of each outside and each catalogue effect
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence

import numpy as np

from tests.blind.field_cost import Values, base_deviations, flat, innovations, left_out, nudge, remaining
from tests.blind.field_recorder import Recorder
from tests.blind.field_rig import Rig
from tests.blind.field_study import RIGS, Study, conditions


def plain(plant: str, truth: Mapping[str, Values], seed: int = 0) -> Study:
    """Return a study with nominal base parameters, the small disturbance and a recorder without faults."""
    rig = RIGS[plant]
    recorder = Recorder((), dict.fromkeys(rig.outputs, 1.0), {}, 0.0, 0.0, 0.0, False, 0, 0.0)
    base = {name: value for name, (value, _) in rig.sheet.items()}
    return Study(seed, plant, "known", {n: dict(v) for n, v in truth.items()}, base, "small", recorder, 0.0, {})


def middling(rig: Rig, name: str, share: float = 1.0) -> list[Values]:
    """Return the parameters of an effect at its start size times `share`, once for each scaled parameter."""
    entry = {**rig.entries, **rig.outside}[name]
    size = share * (np.mean(entry.limits) if entry.fixed else entry.start)
    shape = {p: float(np.mean(between)) for p, between in {**entry.ratio, **entry.shape}.items()}
    units = [{p: float(p == side) for p in entry.scaled} | shape for side in entry.scaled]
    return [entry.at(unit, float(size)) for unit in units]


def mimics(study: Study) -> tuple[float, dict[str, float]]:
    """Return the cost of a study's only effect [nats], and catalogue effect → share of it after imitation."""
    rig = study.rig
    ((name, values),) = study.truth.items()
    p = rig.numbers(study.base, study.truth)
    spread = base_deviations(rig)
    cases = [p | flat(name, left_out(rig, name, values))]
    cases += [p | {n: p[n] + 0.5 * deviation} for n, deviation in spread.items()]
    columns: dict[str, list[list[int]]] = {}
    for other in sorted(set(rig.entries) - {name}):
        columns[other] = []
        for share in (0.2, 1.0):
            group = []
            for put in middling(rig, other, share):
                nudged = {q: v + nudge(rig, other, q, v) for q, v in put.items() if q in rig.entries[other].shape}
                for case in (put, put | nudged) if nudged else (put,):
                    group.append(len(cases))
                    cases.append(p | flat(other, case))
            columns[other].append(group)
    found = innovations(rig, p, cases, conditions(study))
    base = 2.0 * found[:, 1 : 1 + len(spread)]
    whole = remaining(found[:, 0], base, len(spread))
    left = {
        other: min(remaining(found[:, 0], np.column_stack([base, found[:, group]]), len(spread)) for group in groups)
        for other, groups in columns.items()
    }
    return 0.5 * whole, {other: value / max(whole, 1e-9) for other, value in left.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    for plant in arguments or [name for name in RIGS if name != "craft"]:
        rig = RIGS[plant]
        for name in (*rig.outside, *rig.entries):
            cost, left = mimics(plain(plant, {name: middling(rig, name)[0]}))
            nearest = sorted(left.items(), key=lambda item: item[1])[:3]
            told = ", ".join(f"{other} {100 * share:.0f} %" for other, share in nearest)
            print(
                f"{plant:12} {'outside' if name in rig.outside else '':8} {name:20} {cost:10.0f} nats; left by {told}"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
