"""The FMU's own documentation: one HTML page of what it is, its equations and its variables, and the licence."""

from __future__ import annotations

from html import escape
from pathlib import Path

from fmus.description import AUTHOR, LICENCE, Description
from fmus.ports import Port

GUID_PLACEHOLDER = "{guid}"
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #1c2430; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.15rem; margin-top: 2rem; }
pre { background: #f4f6f8; padding: 1rem; overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .9rem; }
th, td { text-align: left; padding: .3rem .6rem; border-bottom: 1px solid #d8dee6; vertical-align: top; }
td.number { font-variant-numeric: tabular-nums; white-space: nowrap; }
"""

PLANT_TEXT = """
<p>A craft on an air table, carried by the table and by two propellers that tilt about the lateral axis. The
duty sets the thrust of each, the tilt turns it forward. An unconnected plant hovers.</p>
<pre>
right/left i, commands δ_i [%] and α_i,cmd [rad]
τ·dT_i/dt = T_OGE(δ_i) − T_i        T_OGE(δ) = max(0, a + b·δ)·g/1000          (4.20, 4.29)
τ·dα_i/dt = α_i,cmd − α_i
Γ(z) = 1/(1 − (R/(4·max(z, R/2)))^k)      z_R/L = z ± L·sin φ                  (4.23, 4.28)
F_ix = T_i·Γ(z_i)·sin α_i,   F_iz = T_i·Γ(z_i)·cos α_i
m·dvx/dt = F_Rx + F_Lx − c·vx,            m·dvy/dt = −(F_Rz + F_Lz)·sin φ − c·vy
Izz·d²ψ/dt² = L·(F_Rx − F_Lx),            Ixx·d²φ/dt² = L·(F_Rz − F_Lz) − k_t·φ − d_t·dφ/dt
dX/dt = vx·cos ψ + vy·sin ψ,              dY/dt = vx·sin ψ − vy·cos ψ
ax = (F_Rx + F_Lx − c·vx)/m
</pre>
<p>Axes: x forward, y to the right, ψ positive to the left seen from above, φ positive with the right side up;
world X forward and Y left at ψ = 0. Equation numbers: J. Jorquera Grau, "Testing Bench Design and Tilting
Propeller System Identification for the Development and Control of a Thrust-vectoring Hovercraft", SDSM&amp;T, 2012.
Integration: RK4 in equal substeps of at most 5 ms, inputs held.</p>
<p>Parameters with a dot, <code>effect.parameter</code>, switch on effects the base model lacks. At their start value
an effect is dormant and costs nothing.</p>
"""

CONTROLLER_TEXT = """
<p>Kalman filter on (ψ, dψ/dt, a_x) and state feedback with saturation, one sample a communication step.</p>
<pre>
x̂ = F·x̂ + G·u,   P = F·P·F' + V                                             (5.37, 5.38)
K = P·H'/(H·P·H' + W),   x̂ += K·(z − H·x̂),   P = (I − K·H)·P               (5.39-5.41)
u = sat(−K_lqr·(x̂ − x_ref), ±tilt_max),   x_ref = (x_ref, 0, psi_ref, 0, 0)  (6.1)
</pre>
<p>State (x, vx, ψ, dψ/dt, a), a the thrust acceleration. The filter starts at <code>*_hat_start</code> with P = 0.
x is not observable with these sensors: the filter must be told where it starts. <code>estimator</code>:
<code>appendix_f</code> as in the thesis, acceleration without memory; <code>lagged</code> with the lag of eqs E.3/E.4;
<code>consistent</code> in which the accelerometer reads total acceleration, a − (c/m)·vx.</p>
<p>Needs numpy, scipy and filterpy in the Python that hosts it. A communication step other than
<code>sample_time</code> is refused.</p>
"""


def write_documentation(folder: Path, about: Description, text: str, version: str, licence: Path) -> None:
    """Write `index.html` and the licence."""
    folder.mkdir(parents=True, exist_ok=True)
    title = escape(about.description)
    groups = (("Inputs", "input"), ("Outputs", "output"), ("Parameters", "parameter"))
    tables = "".join(f"<h2>{head}</h2>{_table([p for p in about.ports if p.causality == c])}" for head, c in groups)
    page = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>'
        f"<h1>{title}</h1><p>Version {escape(version)} · FMI 2.0 co-simulation · communication step {about.step} s<br>"
        f'{AUTHOR} · licence {LICENCE} (<a href="license.txt">text</a>) · GUID <code>{GUID_PLACEHOLDER}</code></p>'
        f"{text}{tables}</html>\n"
    )
    (folder / "index.html").write_text(page, encoding="utf-8")
    if licence.exists():
        (folder / "license.txt").write_bytes(licence.read_bytes())


def _table(ports: list[Port]) -> str:
    rows = "".join(
        f"<tr><td><code>{escape(p.name)}</code></td><td class=number>{'' if p.causality == 'output' else p.start}</td>"
        f"<td>{escape(p.unit)}</td><td>{escape(p.doc)}</td></tr>"
        for p in ports
    )
    return f"<table><tr><th>Variable<th>Start<th>Unit<th>Meaning</tr>{rows}</table>"
