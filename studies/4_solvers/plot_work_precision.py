r"""
Error against time of the solvers
=================================

How accurate is a solver of periodic motions for its computing time? All solvers of the package
start from the same static guess, on two systems: a smooth oleo (the shock strut of an aircraft),
and an oscillator that hits an end stop.
"""

# %%
# **A small version**: schemes with equal steps, on the smooth oleo. ``thesis`` are the second-order
# backward differences of Verbeek (1993), the others are collocation with two or three stages.

# sphinx_gallery_thumbnail_number = -1
import time

import matplotlib.pyplot as plt
import numpy as np

import bayesoleo as bo
from bayesoleo.gallery import Study
from bayesoleo.plots import AFTER, BEFORE, INK, SIMILAR
from bayesoleo.prediction import RunPlan, motion, periodic_orbit

model = bo.system("f16n2d1").with_values({"friction_base": 0.0, "friction_per_pressure": 0.0})
plan = RunPlan("force", 0.5, {"force": motion(2600.0, [1200.0, 150.0])})
phases = np.arange(997) / 997


def solved(scheme, steps):
    """Solve once to compile, then with the clock; return the stroke and the time in ms."""
    for _ in range(2):
        begin = time.process_time()
        answer = periodic_orbit(model, plan, steps=steps, scheme=scheme)
        spent = time.process_time() - begin
    return answer.dof("stroke", phases)[0], 1e3 * spent


exact, _ = solved("radau3", 4096)
figure, axes = plt.subplots(figsize=(8, 4), layout="constrained")
schemes = {"thesis": BEFORE, "radau2": SIMILAR, "radau3": AFTER, "gauss3": "#7a5195"}
for scheme, colour in schemes.items():
    rows = [solved(scheme, steps) for steps in (64, 128, 256, 512, 1024)]
    errors = [np.abs(y - exact).max() / (np.ptp(exact) / 2) for y, _ in rows]
    axes.loglog([ms for _, ms in rows], errors, "o-", color=colour, label=scheme)
    print(f"{scheme:8} error on 64 steps {errors[0]:.1e}, on 1024 steps {errors[-1]:.1e}")
axes.set(xlabel="CPU time of a solve [ms]", ylabel="largest error / amplitude")
axes.legend(frameon=False)
plt.show()

# %%
# All solvers
# -----------
#
# **Equal steps** (:math:`n = 100 \ldots 12\,800`): the schemes above; Radau collocation with three
# stages is the default. **Adaptive**: steps of different lengths, placed by an estimate of the
# error, with edges at the contacts. **Shooting**: integration over one period with its derivative,
# and Newton's method on the initial state. Adaptive meshes and shooting have tolerances from
# :math:`10^{-2}` to :math:`10^{-10}`.
#
# Errors are the largest differences of the stroke over its amplitude, relative to shooting at a
# tolerance of :math:`10^{-13}`. Times are CPU times of one thread, without preparations that do not
# depend on the parameters. The table has the time that is needed to reach an error.

study = Study("work_precision", slow=True, needs=("work_precision",))
solvers = study.helper("work_precision")
measured = study.run(lambda: solvers.measure())


def table():
    """Print the table, version and command."""
    solvers.print_table(measured, (1e-3, 1e-5, 1e-8, 1e-10))
    print(f"bayesoleo {bo.__version__}, no random numbers; to repeat:")
    print("BAYESOLEO_STORE_FIGURES=1 PYTHONPATH=studies python", end=" ")
    print("studies/4_solvers/plot_work_precision.py")


study.text("table", table)

# %%
# The same as a diagram, from the coarsest setting at the left to the finest at the right. Settings
# that did not converge have no point.

LOOKS = {
    "thesis": (BEFORE, "-", "o", "backward differences"),
    "radau2": (SIMILAR, "-", "o", "Radau, 2 stages"),
    "radau3": (AFTER, "-", "o", "Radau, 3 stages (default)"),
    "gauss3": ("#7a5195", "-", "o", "Gauss, 3 stages"),
    "adaptive radau3": ("#009e73", "-", "s", "adaptive, Radau"),
    "adaptive gauss3": ("#009e73", ":", "s", "adaptive, Gauss"),
    "shooting": (INK, "-", "^", "shooting"),
}


def diagram():
    """Error against time, a panel each system."""
    figure, panels = plt.subplots(1, 2, figsize=(10, 5), sharex=True, sharey=True)
    figure.subplots_adjust(left=0.085, right=0.985, top=0.8, bottom=0.115, wspace=0.06)
    for axes, (name, rows) in zip(panels, measured.items(), strict=True):
        for solver, (colour, line, marker, _) in LOOKS.items():
            own = [row for row in rows if row.solver == solver and np.isfinite(row.error)]
            axes.loglog(
                [1e3 * row.seconds for row in own], [row.error for row in own],
                color=colour, ls=line, marker=marker, ms=4, lw=1.5,
            )  # fmt: skip
        axes.set_title(name, loc="left", fontsize=9, fontweight="bold", color=INK)
        axes.set_xlabel("CPU time of a solve [ms]", fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color="0.93", lw=0.8)
        axes.set_axisbelow(True)
        axes.tick_params(labelsize=8)
    panels[0].set_ylabel("largest error / amplitude", fontsize=9)
    panels[0].set_ylim(1e-13, 1e-1)
    handles = [
        plt.Line2D([], [], color=colour, ls=line, marker=marker, ms=4, lw=1.5, label=label)
        for colour, line, marker, label in LOOKS.values()
    ]
    figure.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(0.075, 0.995), ncols=4, frameon=False,
        fontsize=9,
    )  # fmt: skip
    return figure


errors = study.figure("diagram", diagram)

# %%
# On the smooth motion the order decides. A step of the default scheme costs three times a step of
# the backward differences, and a hundred of them are as accurate as ten thousand. Finding a mesh
# takes longer than solving on it, so an adaptive mesh does not pay where equal steps suffice.
# Shooting is an order of magnitude slower than discretisation; in 1993 it was two.
#
# At the end stop the order matters little on equal steps, because the steps in which the contact
# begins and ends dominate the error. Newton's method sometimes fails there and starts again in
# another way, which shows as jumps in time. Shooting stops at each contact and an adaptive mesh has
# edges there, so both keep their order. For stiffer stops see
# :ref:`sphx_glr_gallery_4_solvers_plot_end_stop.py`.
#
# A sampler needs only the left edge of the first panel: its solves start from a neighbouring
# motion, thousands of them in one call.
