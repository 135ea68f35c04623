r"""
Error against time of the solvers
=================================

How much accuracy does a solver of periodic motions give for its time? Here every solver of the
package starts from the same static guess, on two systems: an oleo that is smooth, and one that
hits its end stop.
"""

# %%
# **Equal steps** (:math:`n = 100 \ldots 12\,800`): the second-order backward differences of Verbeek
# (1993), ``thesis``; Radau collocation with two and three stages, of which the latter is the
# default; Gauss collocation with three stages. **Adaptive**: steps of their own lengths, placed by
# an estimate of the error and standing on the contacts. **Shooting**: integration over one period
# with its derivative, and Newton's method on the state that returns. Adaptive meshes and shooting
# are given tolerances from :math:`10^{-2}` to :math:`10^{-10}`.

import matplotlib.pyplot as plt
import numpy as np

import bayesoleo
from bayesoleo.plots import Study, _style as style
from bayesoleo.prediction import RunPlan, motion

model = bayesoleo.system("f16n2d1").with_values(
    {"friction_base": 0.0, "friction_per_pressure": 0.0}
)
plan = RunPlan("force", 0.5, {"force": motion(2600.0, [1200.0, 150.0])})
print(model.name, "at", plan.frequency, "Hz; stroke driven by", *plan.inputs)

# %%
# Errors are largest differences of the stroke over its amplitude, from shooting at a tolerance of
# :math:`10^{-13}`; times are CPU times of one thread, without what can be prepared before the
# parameters are known. The table says how long it takes to get below an error.

study = Study("work_precision", slow=True, needs=("work_precision",))
solvers = study.helper("work_precision")
measured = study.run(lambda: solvers.measure())


def table():
    """With what made it."""
    solvers.print_table(measured, (1e-3, 1e-5, 1e-8, 1e-10))
    print(f"bayesoleo {bayesoleo.__version__}, no random numbers; to repeat:")
    print("BAYESOLEO_STORE_FIGURES=1 PYTHONPATH=studies python", end=" ")
    print("studies/4_solvers/plot_work_precision.py")


study.text("table", table)

# %%
# The same as a diagram, from the coarsest setting at the left to the finest at the right. What did
# not converge has no point.

LOOKS = {
    "thesis": (style.BEFORE, "-", "o", "backward differences"),
    "radau2": (style.SIMILAR, "-", "o", "Radau, 2 stages"),
    "radau3": (style.AFTER, "-", "o", "Radau, 3 stages (default)"),
    "gauss3": ("#7a5195", "-", "o", "Gauss, 3 stages"),
    "adaptive radau3": ("#009e73", "-", "s", "adaptive, Radau"),
    "adaptive gauss3": ("#009e73", ":", "s", "adaptive, Gauss"),
    "shooting": (style.INK, "-", "^", "shooting"),
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
        axes.set_title(name, loc="left", fontsize=style.TEXT, fontweight="bold", color=style.INK)
        axes.set_xlabel("CPU time of a solve [ms]", fontsize=style.TEXT)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color="0.93", lw=0.8)
        axes.set_axisbelow(True)
        axes.tick_params(labelsize=style.SMALL)
    panels[0].set_ylabel("largest error / amplitude", fontsize=style.TEXT)
    panels[0].set_ylim(1e-13, 1e-1)
    handles = [
        plt.Line2D([], [], color=colour, ls=line, marker=marker, ms=4, lw=1.5, label=label)
        for colour, line, marker, label in LOOKS.values()
    ]
    figure.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(0.075, 0.995), ncols=4, frameon=False,
        fontsize=style.TEXT,
    )  # fmt: skip
    return figure


errors = study.figure("diagram", diagram)

# %%
# On the smooth motion order decides: each step of the default scheme costs three times one of the
# backward differences, and a hundred of them are as exact as ten thousand. Finding a mesh takes
# more than solving on it, so that an adaptive mesh does not pay where equal steps will do. And
# shooting is an order of magnitude behind discretisation instead of the two orders of 1993.
#
# At the end stop order is worth little on equal steps: whatever the scheme, the steps in which the
# contact begins and ends decide, and Newton's method is from time to time lost between them and
# has to come again along another way, which shows as jumps in time. Shooting stops at each contact
# and an adaptive mesh has edges there: both keep their order. For stops that are stiffer still,
# see :ref:`sphx_glr_gallery_4_solvers_plot_end_stop.py`.
#
# Inside a sampler only the first panel's left edge matters: there solves start from a neighbour's
# motion, thousands of them in one call.
