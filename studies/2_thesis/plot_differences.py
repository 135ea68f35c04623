r"""
Stability of difference schemes
===============================

Verbeek (1993), section 4.3.1, replaced both derivatives of a periodic motion by second-order
*backward* differences, because combinations with central ones "could go unstable". This page shows
where and why they do, and the scheme that the package uses instead.
"""

# %%
# The test is an oscillator with dry friction, the arctan of the oleo, and a decreasing mass. In the
# oleo, the shock strut of an aircraft, inertia is 39 N at most, beside forces of kilonewtons.

import matplotlib.pyplot as plt
import numpy as np

from bayesoleo import Model, Parameter
from bayesoleo.prediction import RunPlan, motion, periodic_orbit

model = Model(
    "friction oscillator",
    inputs={"force": "N"},
    dofs={"q": "m"},
    parameters={
        "mass": Parameter(1.0, "kg", sd=1.0),
        "damping": Parameter(0.05, "N*s/m", fixed=True),
        "stiffness": Parameter(1.5, "N/m", fixed=True),
        "friction": Parameter(0.4, "N", fixed=True),
        "slope": Parameter(100.0, "s/m", fixed=True),
    },
    equations={
        "q": "mass*ddot(q) + damping*dot(q) + stiffness*q + friction*atan(slope*dot(q)) - force"
    },
    outputs={"displacement": "q"},
)
plan = RunPlan("a", 0.2, {"force": motion(0.0, [2.0])})
schemes = {
    "thesis": "both backward",
    "central": "both central",
    "central-velocity": "velocity central",
    "central-acceleration": "acceleration central",
    "central-euler": "acceleration central, velocity first-order",
    "radau3": "Radau IIA, order 5",
}
phases = np.arange(256) / 256


def displacement(scheme, steps, *, plan=plan, phases=phases, **values):
    """Of one orbit, NaN where there is none."""
    found = periodic_orbit(model, plan, values, steps=steps, scheme=scheme, backend="numpy", jobs=1)
    return found.outputs(phases)["displacement"][0]


# %%
# **Dominant inertia** (left, no friction): all schemes converge at their orders. **Dominant
# friction** (middle, 512 steps, decreasing mass): a central acceleration with a backward velocity
# finds no solution, though the other schemes err as before. **A weak spring** (right, a damper and
# one short pulse each period, 64 steps): two central differences oscillate from node to node after
# the pulse.
#
# The cause is the motion that alternates from node to node. An oscillator with mass :math:`m`,
# damping :math:`c` and stiffness :math:`k` on steps :math:`h` resists it with the stiffness
#
# .. math::
#
#    \frac{12 m}{h^2} + \frac{4 c}{h} + k \quad\text{(both backward)}, \qquad
#    -\frac{4 m}{h^2} + \frac{4 c}{h} + k \quad\text{(acceleration central)}, \qquad
#    -\frac{4 m}{h^2} + k \quad\text{(both central)}.
#
# In the second, inertia has the wrong sign: where the friction's slope times the step comes to the
# mass, the sum is zero and the equations are singular. In the third, damping and friction do not
# hold the alternation at all, only the spring does. Of a first-order equation, such as that of a
# gas's temperature, odd and even nodes are then two separate solutions. Only backward differences
# add up with one sign.

steps = 2 ** np.arange(5, 11)
masses = np.logspace(0, -3, 13)
styles = dict(zip(schemes, ("C0-", "C1-", "C2--", "C3--", "C4:", "k-"), strict=True))
smooth = {"friction": 0.0}
exact = displacement("radau3", 2048, **smooth)
reference = [displacement("radau3", 4096, mass=mass) for mass in masses]
pulse = RunPlan("pulse", 0.2, {"force": motion(0.0, [0.02] * 32)})
weak = {"mass": 0.0, "damping": 0.5, "stiffness": 0.02, "friction": 0.0}
nodes = np.arange(64) / 64

figure, (left, middle, right) = plt.subplots(1, 3, figsize=(10, 4.5), layout="constrained")
for scheme, title in schemes.items():
    error = [np.abs(displacement(scheme, n, **smooth) - exact).max() for n in steps]
    left.loglog(steps, error / np.abs(exact).max(), styles[scheme], label=title)
    error = [
        np.abs(displacement(scheme, 512, mass=mass) - true).max() / np.abs(true).max()
        for mass, true in zip(masses, reference, strict=True)
    ]
    middle.loglog(masses, np.where(np.array(error) < 1, error, np.nan), styles[scheme])
    print(f"{title:45s} of {len(masses)} masses {int(np.sum(np.array(error) < 1))} solved")
    if scheme in ("thesis", "central", "radau3"):
        answer = displacement(scheme, 64, plan=pulse, phases=nodes, **weak)
        right.plot(nodes, answer, styles[scheme], lw=1)
for axes in (left, middle):
    axes.set(ylabel="largest error over largest stroke", ylim=(1e-11, 3))
left.set(xlabel="steps in a period", title="no friction, 1 kg")
middle.set(xlabel="mass [kg]", title="friction; no line: no solution")
middle.invert_xaxis()
right.set(xlabel="phase [cycles]", ylabel="displacement [m]", title="a pulse, a weak spring")
figure.legend(loc="outside lower center", ncols=3, frameon=False)
plt.show()

# %%
# A central velocity with a backward acceleration is safe where there is mass. But what depends on
# nodes before and behind cannot be solved in one sweep through the period. Collocation looks at one
# step at a time, and gains orders instead.
