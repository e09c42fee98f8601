"""Planar motion of a body with heading, in local and world axes.

Local axes: forward and to the right; heading positive to the left, seen from above. World axes: X forward and Y left at
heading 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from cosim.model.namespaces import Namespace


def world_velocity(m: Namespace, heading: Any, forward: Any, right: Any) -> tuple[Any, Any]:
    """Return the velocity in world axes from its components in local axes.

    With v forward, w rightward and heading ψ: Ẋ = v·cos ψ + w·sin ψ, Ẏ = v·sin ψ − w·cos ψ.
    """
    s, c = m.sin(heading), m.cos(heading)
    return forward * c + right * s, forward * s - right * c


# The map (a rotation and a mirror) is its own inverse, so it also transforms world vectors to local axes.
local_vector = world_velocity


@dataclass(frozen=True)
class PlanarFrame:
    """Signal names of a planar motion: world position, heading and local velocities."""

    x: str
    y: str
    heading: str
    forward: str
    right: str

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of all signals of the frame."""
        return self.x, self.y, self.heading, self.forward, self.right

    @property
    def local(self) -> set[str]:
        """Return the names of local velocities and heading."""
        return {self.heading, self.forward, self.right}
