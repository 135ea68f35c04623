r"""
Drop tests predicted from the shaker
====================================

An oleo is the shock strut of an aircraft. A shaker moves it slowly, a drop test fast. Verbeek
(1993), section 6.4, predicted two drop tests with parameters from the shaker, and had to double the
orifice damping to fit them. This page asks how well shaker data determine that damping.
"""

# %%
# A mass on top of the extended oleo is released. ``drop_test`` turns an oleo into the model of this
# test: it has no input, gravity compresses it, and the force is an output.

import matplotlib.pyplot as plt
import numpy as np

import bayesoleo
from bayesoleo.gallery import Study
from bayesoleo.prediction import Predictor, transient_record
from bayesoleo.systems import drop_test

NEEDS = ("drop_tests", "shaker_tables")
study = Study("drop_tests", data="campaigns/shaker-plain", slow=True, needs=NEEDS)
tests, shaker = study.helper("drop_tests"), study.helper("shaker_tables")

# %%
# **Orifice damping from the shaker.** The prior of :math:`\theta_3` has a standard deviation of 10
# %. At 0.1 m/s its force is 29 N, less than the 90 N to which the thesis's force sensor is
# accurate.

found = study.run(lambda: tests.fitted(shaker.Shaker.load().reduced.records))

study.text("damping", lambda: tests.print_damping(found))

# %%
# A slow run alone adds no information, as the output says. All fourteen runs do, but only because
# the noise is independent between samples and the model is exact: fifty thousand samples average 20
# N to a tenth of a newton. Systematic errors, like the thesis's 90 N, do not average out. There
# :math:`\theta_3` should keep its prior.
#
# **The drops** are predicted in both ways, with 200 draws of the parameters each. A constant that
# was held is drawn from its prior. The truth is simulated with the true parameters where they are
# given, and with the joint estimate otherwise.

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
# A scatter of a few per cent between runs makes the pressure of the heavy drop uncertain by a
# factor of two, because the stroke ends near the pole of the gas law. Beyond 264 mm the oleo would
# hit the stop, which these models lack. The 10 % of the damping matter little in comparison. The
# draws are independent between parameters, because the table has no correlations.

# %%
# **The thesis's remedy.** With nominal parameters, twice the orifice damping fitted the light drop
# and 2.3 times the heavy one. The peaks of velocity and pressure fall. The end does not change: the
# gas of the model cools for half a minute and the oleo sinks further, while the real one had come
# to rest. Pressures are absolute.

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
