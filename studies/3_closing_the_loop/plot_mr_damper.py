r"""
A measured damper: friction with memory and a gas spring
========================================================

A gas-charged magnetorheological damper was measured without current on a crank table (Vargas 2021).
The first model is a viscous damper whose force has an unknown offset in every run. The package
finds the effects that this model lacks.
"""

# %%
# Runs 1 and 5 are fitted, 3 and 7 are held out. Of a held-out run only the offset is estimated.

import json
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import bayesoleo as bo
from bayesoleo import Model, Output, Parameter, plots
from bayesoleo.effects import called, find_effect
from bayesoleo.gallery import Study, print_before_after
from bayesoleo.prediction import RunPlan, motion

FIT, HELD = "fit", "hold-out"
RUNS = {"1": (0.840, FIT), "3": (0.899, HELD), "5": (0.970, FIT), "7": (1.053, HELD)}
DECLARATION = """
format = 1
name = "mr_damper"
dataset = "mr_damper"
channels.displacement = {column = "dist", unit = "mm"}
channels.force = {column = "forc", unit = "N"}
""" + "".join(
    f"""
[[runs]]
label = "{label}"
file = "ensaio{label}.1.mat"
kind = "periodic"
frequency = {frequency}
sample_rate = 100.0
start = 5.0
role = "{role}"
"""
    for label, (frequency, role) in RUNS.items()
)

model = Model(
    "viscous damper",
    inputs={"displacement": "m"},
    parameters={
        "damping": Parameter(1000.0, "N*s/m", sd=1000.0, bounds=(0.0, 1e5)),
        "force_offset": Parameter(0.0, "N", sd=500.0, by_run=True),
    },
    outputs={
        "force": Output({"damping": "damping*dot(displacement)", "offset": "force_offset"}, "N")
    },
)

# %%
# First a test with a known answer: a simulated damper with dry friction besides. Friction is found.

truth = Model(
    "damper with dry friction",
    inputs=model.inputs,
    parameters=model.parameters,
    outputs={"force": Output("damping*dot(displacement) + 60*tanh(dot(displacement)/0.003)", "N")},
)
plans = [RunPlan(n, f, {"displacement": motion(0.0, [0.02])}, role=r) for n, (f, r) in RUNS.items()]
folder = Path(tempfile.mkdtemp()) / "damper"
simulated = bo.Campaign.simulate(folder, truth, plans, noise={"displacement": 1e-5, "force": 3.0})
effects = [find_effect(name) for name in ("coulomb_friction", "linear_stiffness", "lugre_friction")]
known = bo.Problem(simulated, model).fit().explain(effects=effects, max_effects=1)
print(known.effects, known.verdict)
figure = known.plot()

# %%
# The measured damper: one call estimates the model, tests the whole catalogue and adds effects.

study = Study("mr_damper", data="measured/mr_damper", slow=True, declaration=DECLARATION)
problem = study.run(lambda: bo.Problem(study.campaign, model, seed=0, quick=True))
found = study.run(lambda: problem.fit().explain())
study.run(lambda: found.sample())
tree = found and found.tree
summary = tree and json.loads(tree.attrs["summary"])
study.text("summary", lambda: print(found))

# %%
# The scores of the first round. The friction models with memory are equivalent here: with one
# amplitude of the crank they describe the same loop.

ranking = study.figure("ranking", lambda: plots.ranking(tree, most=8))

# %%
# The error of the held-out runs, round by round. ``rms`` is the error of the raw samples. It
# includes the part that does not repeat from period to period, which no periodic model explains.


def rounds():
    """Error of the hold-out runs in each round, and what was added then."""
    print("round   rms of 3   rms of 7   added")
    for number, entry in enumerate(summary["rounds"], 1):
        error = entry["error"]["force"]
        row = "".join(f"{error[run]['rms']:9.2f} N" for run in ("3", "7"))
        print(f"{number:5}{row}   {called(entry['accepted'] or '–', summary['titles'])}")
    reached = all(error[run]["rms"] <= 9.0 for run in ("3", "7"))
    print(f"The mark, 9 N rms on each hold-out run, is {'reached' if reached else 'missed'}.")


study.text("rounds", rounds)

# %%
# The errors before and after, and the posterior of the effects that were added.

study.text("before_after", lambda: print_before_after(summary, "N", 1.0))

# %%
# The repeating error is still several times its noise, as the summary says. The effects that were
# added last describe the remainder rather than explain it.
#
# The figure shows force over displacement and velocity of the held-out runs, averaged over periods.
# A viscous damper is an ellipse on the left and a line on the right. The measured loop has the
# corners of dry friction and the slope of a spring. Its width on the right is memory.


def loops():
    """Average period of the hold-out runs: measured, model before, model after."""
    measured, predicted = tree["records"].to_dataset(), tree["prediction"].to_dataset()
    velocity = tree["residual"].to_dataset()["velocity"]
    curves = (
        (measured["force"], "#b4bac3", 5.0, "measured"),
        (predicted["force_before"], "#d55e00", 1.4, "viscous model"),
        (predicted["force_after"], "#0072b2", 1.4, "with the added effects"),
    )
    figure, panels = plt.subplots(2, 2, figsize=(10, 7), sharey=True, layout="constrained")
    for row, run in zip(panels, ("3", "7"), strict=True):
        phase = measured["phase"].sel(run=run).dropna("sample") % 1
        bins = np.floor(100 * phase).rename("bin")

        def average(values, run=run, bins=bins):
            """Over samples of equal phase; closed to a loop."""
            mean = values.sel(run=run)[: bins.size].groupby(bins).mean()
            return np.append(mean, mean[0])

        across = {
            "displacement in mm": 1e3 * average(measured["displacement"]),
            "velocity in mm/s": 1e3 * average(velocity),
        }
        for axes, (text, x) in zip(row, across.items(), strict=True):
            for force, colour, width, label in curves:
                axes.plot(x, average(force), color=colour, lw=width, label=label)
            axes.set(xlabel=text, title=f"run {run}, held out")
            axes.spines[["top", "right"]].set_visible(False)
        row[0].set_ylabel("force in N")
    panels[0, 0].legend(frameon=False)
    return figure


figure = study.figure("loops", loops)
# sphinx_gallery_thumbnail_number = -1
