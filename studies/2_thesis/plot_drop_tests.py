r"""
Drop tests predicted from the shaker
====================================

A shaker moves an oleo slowly; a drop does not. Verbeek (1993), section 6.4, predicted two drop
tests with the parameters found on the shaker and had to double the orifice damping to fit them.
This page asks what the shaker could have known, with the simulated campaign ``shaker-plain``, and
with the thesis's own numbers.
"""

# %%
# The mass sits on top and is released with the oleo extended. ``drop_test`` turns an oleo into that
# model: no input, gravity compresses, and the force is an output.

import matplotlib.pyplot as plt
import numpy as np

import bayesoleo
from bayesoleo.plots import Study
from bayesoleo.prediction import Predictor, transient_record
from bayesoleo.systems import drop_test

NEEDS = ("drop_tests", "shaker_tables")
study = Study("drop_tests", data="campaigns/shaker-plain", slow=True, needs=NEEDS)
tests, shaker = study.helper("drop_tests"), study.helper("shaker_tables")

# %%
# **What does the shaker say of the orifice damping** :math:`\theta_3`? It is known beforehand to 10
# %. At 0.1 m/s it makes 29 N, below the 90 N to which the thesis's force sensor is accurate.

found = study.run(lambda: tests.fitted(shaker.Shaker.load().reduced.records))

study.text("damping", lambda: tests.print_damping(found))

# %%
# A slow run alone adds nothing, and the output says so. All fourteen together do, but only because
# the noise of this campaign is independent from sample to sample and the model is exact: fifty
# thousand samples average 20 N down to a tenth of a newton. A rig whose errors are systematic, like
# the thesis's 90 N, has no such average, and there :math:`\theta_3` should be left to its
# tolerance.
#
# **The drops** then are predicted both ways, with 200 draws of the parameters each; a constant that
# was held is drawn from its tolerance. The truth is simulated with the true parameters as far as
# they are given, and the joint estimate for the rest.

made = study.run(lambda: tests.predictions_of(found))

study.text("peaks", lambda: tests.print_drops(made))


def histories(first, second, truth):
    """Figures 6.6 to 6.9: 95 % bands of two predictions, by output and mass."""
    rows = (("displacement", 1e3, "mm"), ("force", 1e-3, "kN"), ("pressure", 1e-5, "bar"))
    figure, panels = plt.subplots(3, 2, figsize=(10, 8), sharex=True, layout="constrained")
    for column, (mass, predictions) in zip(panels.T, made.items(), strict=True):
        for axes, (output, scale, unit) in zip(column, rows, strict=True):
            for title, colour in ((first, "#56b4e9"), (second, "#d55e00")):
                drop = predictions[title]
                axes.fill_between(
                    drop.time,
                    *(scale * drop.interval(output)),
                    color=colour,
                    alpha=0.4,
                    label=title,
                )
            if truth:
                axes.plot(drop.time, scale * predictions["truth"].centre[output], "k", lw=0.8)
            axes.set_ylabel(f"{output} [{unit}]")
        column[0].set_title(f"{mass:g} kg")
        column[-1].set_xlabel("time [s]")
    panels[0, 0].legend(frameon=False, fontsize="small")
    return figure


bands = study.figure("bands", lambda: histories("all runs, held", "all runs, estimated", True))

# %%
# Black is the truth. **With table 6.7's means**, rebuilt from table 6.5, and their scatter over
# runs:

thesis = study.figure(
    "thesis",
    lambda: histories("table 6.7, f16n2d2_thesis", "table 6.7, f16n2d2_thesis_printed", False),
)

# %%
# What scatters by a few per cent from run to run makes the pressure of the heavy drop uncertain by
# a factor of two, since it ends next to the pole of the gas law; strokes beyond 264 mm would have
# hit the stop, which no model here has. Beside that the 10 % of the damping, above, are little. The
# draws are independent between parameters, as the table says nothing of how they go together.

# %%
# **The thesis's remedy, and what it leaves.** Nominal parameters: twice the orifice damping
# fitted the light drop, 2.3 times the heavy one. Peaks of velocity and pressure fall. The end stays
# as it is: for half a minute the gas of the model cools and the oleo sinks on, while the real one
# had come to rest. Pressures are absolute.

time = np.linspace(0.0, 40.0, 20_001)


def nominal_drop(mass, factor):
    """Outputs of a drop with nominal parameters and the damping times a factor, SI."""
    model = bayesoleo.system("f16n2d2")
    damping = factor * model.parameters["orifice_damping"].value
    dropped = drop_test(model.with_values({"orifice_damping": damping}), mass)
    nothing = {name: np.zeros(time.size) for name in dropped.outputs}
    conditions = {"initial_pressure": 4.9e5, "ambient_temperature": 293.0}
    record = transient_record("drop", time, nothing, conditions=conditions)
    predictor = Predictor(dropped, [record])
    theta = predictor.layout.start(dropped)
    predictor.set_anchor(theta)
    return dict(zip(predictor.outputs, predictor.simulate(theta[None], 0).y[0], strict=True))


print("   kg  damping   peak m/s   peak bar   stroke at 2.5, 24, 40 s [mm]")
drops = {}
for mass, factor in ((350.0, 1.0), (350.0, 2.0), (825.0, 1.0), (825.0, 2.3)):
    y = drops[mass, factor] = nominal_drop(mass, factor)
    stroke, peak = 1e3 * y["displacement"], 1 + y["pressure"].max() / 1e5
    speed = np.gradient(y["displacement"], time).max()
    ends = ", ".join(f"{value:.0f}" for value in np.interp([2.5, 24.0, 40.0], time, stroke))
    print(f"{mass:5.0f}  × {factor:3.1f}   {speed:9.2f} {peak:10.1f}   {ends}")

figure, (fast, slow) = plt.subplots(1, 2, figsize=(10, 4), sharey=True, layout="constrained")
for (mass, factor), y in drops.items():
    for axes in (fast, slow):
        line = "-" if factor == 1.0 else "--"
        colour = "#0072b2" if mass == 350.0 else "#d55e00"
        label = f"{mass:g} kg, damping × {factor:g}"
        axes.plot(time, 1e3 * y["displacement"], line, color=colour, lw=1.2, label=label)
fast.set(xlim=(0, 2.5), xlabel="time [s]", ylabel="displacement [mm]", title="the drop")
slow.set(xlim=(0, 40), xlabel="time [s]", title="the cooling")
slow.legend(frameon=False, loc="lower right")
plt.show()
