r"""
An end stop, ever stiffer
=========================

An oleo that reaches its end hits metal. Verbeek (1993, section 4.3.3) puts a spring there,

.. math::

   \ddot q + \dot q |\dot q| + 10 \left(\frac{1}{1-q}\right)^{1.2} + k(q)\, q
   = 23 + 20 \cos 2 \pi t,

with :math:`k = \theta` for :math:`q < 0` and zero otherwise. Equal steps carried him to
:math:`\theta = 2500`; beyond he had to shoot, to :math:`10^{11}`, and wished for a mesh that places
its own steps. This page has it.
"""

# %%
# The contact lasts :math:`\pi/\sqrt{\theta}`: at :math:`10^{11}` a hundred-thousandth of a period.
# The solver ``adaptive`` of :func:`~bayesoleo.prediction._orbits.periodic_orbit` places steps by an
# estimate of their error, with edges on the ends of the contact, and walks up the stiffness where a
# direct solution fails.

import matplotlib.pyplot as plt
import numpy as np

import bayesoleo
from bayesoleo.plots import Study, _style as style
from bayesoleo.prediction import RunPlan, motion, periodic_orbit

model = bayesoleo.system("end_stop")
plan = RunPlan("end stop", 1.0, {"force": motion(23.0, [20.0])})
answer = periodic_orbit(
    model, plan, {"stop_stiffness": 2500.0}, "adaptive", tolerance=1e-6, backend="numpy"
)
orbit = answer.orbits[0]
print(orbit.status.message, "on", orbit.phases.size, "steps;")
print("largest multiplier", np.abs(orbit.multipliers).max().round(3))
print("q(0) =", orbit.states[0, 0].round(8), "and it should be", 0.83680069)

# %%
# The whole table, by the adaptive mesh and by shooting, both from a static guess and compared with
# sixty periods of LSODA at a relative tolerance of :math:`10^{-9}`. What differs is LSODA's own
# error: the two agree better with each other.

study = Study("end_stop", slow=True, needs=("end_stop",))
table = study.helper("end_stop")
stops = study.run(lambda: table.solve_all())
study.text("states", lambda: table.print_states(stops))

# %%
# A stop that is a thousand million times stiffer needs no more steps, only shorter ones in the
# contact, which in its own scale is always the same motion: half a period of a mass on a spring.

SHADES = ("#a8d1ee", "#6fb1de", "#3a8fc9", "#1667a0", "#0a3a5f")


def orbits():
    """One period; the contact; the lengths of the steps."""
    figure, (whole, contact, lengths) = plt.subplots(1, 3, figsize=(10, 3.7))
    figure.subplots_adjust(left=0.06, right=0.985, top=0.8, bottom=0.15, wspace=0.27)
    phase = np.linspace(0.0, 1.0, 2001)
    for stop, colour in zip(stops, SHADES, strict=True):
        whole.plot(phase, stop.answer.dof("stroke", phase)[0], color=colour, lw=1.5)
        touch, leave = stop.contact()
        speed, edges = np.sqrt(stop.stiffness), stop.answer.motions[0].solution.mesh.edges
        around = np.linspace(touch - 0.8 / speed, leave + 0.8 / speed, 800)
        inside = edges[(edges > around[0]) & (edges < around[-1])]
        for at, look in ((around, "-"), (inside, ".")):
            scaled = speed * stop.answer.dof("stroke", at)[0]
            contact.plot(speed * (at - touch), scaled, look, color=colour, lw=1.5, ms=4)
        count = np.arange(edges.size) - np.searchsorted(edges, touch)
        lengths.stairs(np.diff(edges), count, color=colour, lw=1.5, baseline=None)
    contact.axhline(0, color=style.NEUTRAL, lw=0.8, zorder=0)
    whole.axhline(0, color=style.NEUTRAL, lw=0.8, zorder=0)
    lengths.set_yscale("log")
    whole.set(xlabel="phase [cycles]", ylabel="stroke q")
    contact.set(xlabel=r"time since touching $\times\sqrt{\theta}$", ylabel=r"$q\sqrt{\theta}$")
    lengths.set(xlabel="steps since touching", ylabel="length of a step [cycles]")
    names = ("a period", "the contact in its own scale", "the mesh")
    for axes, name in zip((whole, contact, lengths), names, strict=True):
        axes.set_title(name, loc="left", fontsize=style.TEXT, fontweight="bold", color=style.INK)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=style.SMALL)
    handles = [
        style.line(colour, rf"$\theta = {name}$")
        for name, colour in zip(("100", "2500", "10^5", "10^8", "10^{11}"), SHADES, strict=True)
    ]
    style.legend(figure, handles)
    return figure


figure = study.figure("orbits", orbits)

# %%
# **Equal steps** fail from the static guess on, as the thesis found, whatever their order and
# number. Started on the very answer, some stay there; how well, is chance: at :math:`10^{11}` all
# of the contact lies inside one step, and what a scheme makes of it depends on whether one of its
# points is hit.

study.text("equal", lambda: table.print_equal(stops))

# %%
# CPU milliseconds from the static guess. Shooting stops at each contact and does not notice how
# stiff it is. The adaptive mesh pays for its walk, once: a solution nearby is found from there
# without one, and has exact derivatives by all parameters like any other.


def times():
    """With what made it."""
    table.print_times(stops)
    print(f"bayesoleo {bayesoleo.__version__}, no random numbers; to repeat:")
    print("BAYESOLEO_STORE_FIGURES=1 PYTHONPATH=studies python studies/4_solvers/plot_end_stop.py")


study.text("times", times)
