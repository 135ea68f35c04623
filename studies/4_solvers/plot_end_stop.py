r"""
End stops of increasing stiffness
=================================

An oleo, the shock strut of an aircraft, hits metal at the end of its stroke. Verbeek (1993, section
4.3.3) describes the stop by a spring,

.. math::

   \ddot q + \dot q |\dot q| + 10 \left(\frac{1}{1-q}\right)^{1.2} + k(q)\, q
   = 23 + 20 \cos 2 \pi t,

with :math:`k = \theta` for :math:`q < 0` and zero otherwise. Equal steps reached
:math:`\theta = 2500`. Beyond, up to :math:`10^{11}`, he needed a shooting method. This page uses an
adaptive mesh.
"""

# %%
# The contact lasts :math:`\pi/\sqrt{\theta}`: at :math:`10^{11}` a hundred-thousandth of a period.
# The solver ``adaptive`` of :func:`~bayesoleo.prediction.periodic_orbit` places its steps by an
# estimate of their error, with edges at the ends of the contact. Where a direct solution fails, it
# raises the stiffness step by step.

import matplotlib.pyplot as plt
import numpy as np

import bayesoleo as bo
from bayesoleo.gallery import Study
from bayesoleo.prediction import RunPlan, motion, periodic_orbit

model = bo.system("end_stop")
plan = RunPlan("end stop", 1.0, {"force": motion(23.0, [20.0])})
STIFFNESS = (100.0, 2500.0, 1e5, 1e8, 1e11)
answers = {}
for theta in STIFFNESS:
    answers[theta] = periodic_orbit(
        model, plan, {"stop_stiffness": theta}, "adaptive", tolerance=1e-6,
        stiffness="stop_stiffness",
    )  # fmt: skip
    orbit = answers[theta].orbits[0]
    start, steps = orbit.states[0, 0], orbit.phases.size
    print(f"theta {theta:7.1e}: {orbit.status.message} on {steps} steps, q(0) = {start:.8f}")

# %%
# A stop that is a thousand million times stiffer needs no more steps, only shorter ones in the
# contact. In its own scale the contact is always the same motion: half a period of a mass on a
# spring.

SHADES = ("#a8d1ee", "#6fb1de", "#3a8fc9", "#1667a0", "#0a3a5f")
phase = np.linspace(0.0, 1.0, 2001)
figure, (whole, contact, lengths) = plt.subplots(1, 3, figsize=(10, 3.9), layout="constrained")
for (theta, answer), colour in zip(answers.items(), SHADES, strict=True):
    speed, edges = np.sqrt(theta), np.append(answer.orbits[0].phases, 1.0)
    fine = (edges[:-1, None] + np.diff(edges)[:, None] * np.arange(40) / 40).ravel()
    touching = answer.dof("stroke", fine)[0] < 0.0
    touch, leave = fine[np.flatnonzero(touching[1:] != touching[:-1]) + 1][[0, -1]]
    around = np.linspace(touch - 0.8 / speed, leave + 0.8 / speed, 800)
    label = rf"$\theta$ = {theta:g}"
    whole.plot(phase, answer.dof("stroke", phase)[0], color=colour, label=label)
    contact.plot(speed * (around - touch), speed * answer.dof("stroke", around)[0], color=colour)
    count = np.arange(edges.size) - np.searchsorted(edges, touch)
    lengths.stairs(np.diff(edges), count, color=colour, lw=1.5, baseline=None)
lengths.set_yscale("log")
whole.set(title="a period", xlabel="phase [cycles]", ylabel="stroke q")
contact.set(title="the contact in its own scale", ylabel=r"$q\sqrt{\theta}$")
contact.set_xlabel(r"time since touching $\times\sqrt{\theta}$")
lengths.set(title="the mesh", xlabel="steps since touching", ylabel="length of a step [cycles]")
for axes in (whole, contact, lengths):
    axes.spines[["top", "right"]].set_visible(False)
figure.legend(loc="outside upper center", ncols=5, frameon=False)
plt.show()

# %%
# The table compares the adaptive mesh and shooting with sixty periods of LSODA at a relative
# tolerance of :math:`10^{-9}`. The differences are the error of LSODA: the two solvers agree better
# with each other.

study = Study("end_stop", slow=True, needs=("end_stop",))
table = study.helper("end_stop")
stops = study.run(lambda: table.solve_all())
study.text("states", lambda: table.print_states(stops))

# %%
# **Equal steps** fail from the static guess, as the thesis found, whatever their order and number.
# Started at the solution, some schemes stay there. How accurately is chance: at :math:`10^{11}` the
# whole contact lies within one step, and the result depends on whether a point of the scheme falls
# into it.

study.text("equal", lambda: table.print_equal(stops))

# %%
# CPU time in milliseconds, from the static guess. Shooting stops at each contact, so its time does
# not depend on the stiffness. The adaptive mesh needs time to raise the stiffness, but only once:
# solutions nearby start from the first one. They have exact derivatives with respect to all
# parameters.


def times():
    """Print times, version and command."""
    table.print_times(stops)
    print(f"bayesoleo {bo.__version__}, no random numbers; to repeat:")
    print("BAYESOLEO_STORE_FIGURES=1 PYTHONPATH=studies python studies/4_solvers/plot_end_stop.py")


study.text("times", times)
