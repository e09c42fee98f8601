"""Motion in a plane: a body that points somewhere, in axes of its own and of the world.

Local axes: forward and to the right; heading positive to the left seen from above. World axes: X forward and Y left at
heading 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from cosim.model.namespaces import Namespace


def world_velocity(m: Namespace, heading: Any, forward: Any, right: Any) -> tuple[Any, Any]:
    """Velocity in world axes, v forward, w rightward, ψ the heading: Ẋ = v·cos ψ + w·sin ψ, Ẏ = v·sin ψ − w·cos ψ."""
    s, c = m.sin(heading), m.cos(heading)
    return forward * c + right * s, forward * s - right * c


# The map is its own inverse (a rotation and a mirror), so a world vector reaches local axes by it too.
local_vector = world_velocity


@dataclass(frozen=True)
class PlanarFrame:
    """Which signals of a model are a motion in a plane: world position, heading, and local velocities."""

    x: str
    y: str
    heading: str
    forward: str
    right: str

    @property
    def names(self) -> tuple[str, ...]:
        """All of them."""
        return self.x, self.y, self.heading, self.forward, self.right

    @property
    def local(self) -> set[str]:
        """The local velocities, and the heading by which they turn into the world's."""
        return {self.heading, self.forward, self.right}
