"""FMI variables common to controller and estimators of the craft."""

from __future__ import annotations

from cosim.fmi.ports import Port

ESTIMATED = {  # name → unit, meaning
    "x": ("m", "distance along the craft's own axis"),
    "vx": ("m/s", "forward velocity"),
    "psi": ("rad", "heading"),
    "psi_dot": ("rad/s", "yaw rate"),
    "a": ("m/s2", "thrust acceleration"),
}
ESTIMATE = tuple(f"{name}_hat" for name in ESTIMATED)
MEASURED = (
    Port("psi", "input", 0.0, "rad", "measured heading, positive to the left"),
    Port("psi_dot", "input", 0.0, "rad/s", "measured yaw rate"),
    Port("ax", "input", 0.0, "m/s2", "measured forward acceleration"),
)
ESTIMATES = tuple(
    Port(f"{name}_hat", "output", 0.0, unit, f"estimated {doc}") for name, (unit, doc) in ESTIMATED.items()
)


def fix_ports(of_y: str = "") -> tuple[Port, ...]:
    """Return the optional ports of position fixes; `of_y` is a remark on y."""
    return (
        Port("x_meas", "input", 0.0, "m", "fix of x, the distance along the craft's own axis", optional=True),
        Port("y_meas", "input", 0.0, "m", f"fix of y, the drift to the right{of_y}", optional=True),
        Port(
            "fix", "input", 0.0, "1", "number of the latest fix, 0 before the first; a new one is used", optional=True
        ),
    )


def sigma_ports(who: str) -> tuple[Port, ...]:
    """Return ports for the standard deviations of x and ψ."""
    return tuple(
        Port(f"{name}_sigma", "output", 0.0, unit, f"standard deviation of {name}_hat the {who} believes in")
        for name, unit in (("x", "m"), ("psi", "rad"))
    )


def start_ports(who: str) -> tuple[Port, ...]:
    """Return ports for the start of the estimate."""
    return tuple(
        Port(f"{p.name}_start", "parameter", 0.0, p.unit, f"start value of {p.name}; the {who} knows where it starts")
        for p in ESTIMATES
    )
