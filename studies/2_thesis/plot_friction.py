r"""
Friction estimated run by run
=============================

Verbeek (1993) read the friction of each shaker run off its force record by hand, and drew a line
through these values over the pressure. Here both are estimated: one amplitude for each run and,
independently, the line itself.
"""

# %%
# The friction of the oleo is :math:`(\theta_8 + \theta_9 p) \arctan(\theta_{10} \dot q)`. To test
# the dependence on pressure, the definition ``friction_amplitude`` of the built-in model is
# replaced by a parameter of each run. All other parameters are common to all runs.

# sphinx_gallery_thumbnail_number = -1
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import bayesoleo as bo
from bayesoleo.gallery import Study
from bayesoleo.model import driven_by
from bayesoleo.prediction import RunPlan, motion

amplitude = bo.Parameter(100.0, "N", relative_sd=1.0, by_run=True)
oleo = bo.system("f16n2d2")
model = (
    oleo.fixing("friction_base", "friction_per_pressure", "orifice_damping")
    .with_parameters(friction_of_run=amplitude)
    .with_definition("friction_amplitude", "friction_of_run")
)

# %%
# A small simulated test: five runs with the same motion about different positions of the stroke,
# and so at different pressures.

plans = [
    RunPlan(
        f"{mean} mm", 0.5, {"displacement": motion(1e-3 * mean, [0.02])},
        {"initial_pressure": 4.9e5, "ambient_temperature": 293.0}, samples_per_period=400.4,
    )
    for mean in (40, 90, 140, 190, 225)
]  # fmt: skip
noise = {"displacement": 5e-5, "force": 20.0, "pressure": 5e3}
folder = Path(tempfile.mkdtemp()) / "shaker"
campaign = bo.Campaign.simulate(folder, driven_by(oleo, "displacement"), plans, noise=noise)
found = bo.Problem(campaign, model, error_model="independent").fit().parameters
amplitudes = found[found.index.str.startswith("friction_of_run")]
pressure = [np.mean(run.samples["pressure"]) + 1e5 for run in campaign.reduced.records]

figure, axes = plt.subplots(figsize=(8, 3.6), layout="constrained")
base, slope = (oleo.parameters[f"friction_{name}"].value for name in ("base", "per_pressure"))
grid = np.array([0.0, 1.05 * max(pressure)])
axes.plot(grid / 1e5, base + slope * grid, color="#0072b2", label="true line")
bars = 2 * amplitudes["sd"]
axes.errorbar(np.array(pressure) / 1e5, amplitudes["estimate"], bars, fmt="k.", label="run ± 2 sd")
axes.set(xlabel="mean absolute pressure of the run [bar]", ylabel="friction amplitude [N]")
axes.legend(frameon=False)
plt.show()

# %%
# Fourteen runs of a larger simulated campaign are now estimated jointly from the raw samples of
# force and pressure, driven by the displacement. The force steps at a reversal within a few
# samples. A record resampled to a coarse grid, or described by harmonics, would lose the slope
# :math:`\theta_{10}`, which the thesis could not find.

study = Study("friction", data="campaigns/shaker-plain", needs=("shaker_tables",))
tables = study.helper("shaker_tables")
shaker = study.run(lambda: tables.Shaker.load())
study.text("line", lambda: tables.print_friction(shaker))

# %%
# The line through fourteen amplitudes and the line estimated directly agree to 1 %. They are not
# the same quantity. The pressure changes within a run, by a factor of ten in runs *a* and *b*, and
# a constant amplitude is a compromise over the cycle. It also biases the slope, because it is wrong
# where the motion reverses. The direct estimate is therefore the better one.


def figure_6_1():
    """Friction amplitude against pressure with both lines and what is left of each run."""
    found = shaker.friction()
    p = np.linspace(4e5, 30e5, 50)
    figure, (upper, lower) = plt.subplots(
        2, 1, figsize=(8, 6), sharex=True, height_ratios=(3, 1), layout="constrained"
    )
    upper.plot(p / 1e5, found.joint[0] + found.joint[1] * p, color="#0072b2", label="direct")
    upper.plot(
        p / 1e5, found.line[0] + found.line[1] * p, "--", color="#d55e00", label="through runs"
    )
    upper.errorbar(found.pressure / 1e5, found.amplitude, 2 * found.sd, fmt="k.", label="run")
    for run in found.amplitude.run.values:
        place = float(found.pressure.sel(run=run)) / 1e5, float(found.amplitude.sel(run=run))
        upper.annotate(str(run), place, (4, -11), textcoords="offset points")
    left = found.amplitude - found.line[0] - found.line[1] * found.pressure
    lower.axhline(0, color="#d55e00", ls="--")
    lower.errorbar(found.pressure / 1e5, left, 2 * found.sd, fmt="k.")
    upper.set_ylabel("friction amplitude [N]")
    upper.legend(frameon=False)
    lower.set(xlabel="mean absolute pressure of the run [bar]", ylabel="run − line [N]")
    return figure


line = study.figure("line", figure_6_1)

# %%
# Bars are two standard deviations. The next table has the heat conduction estimated from each run
# alone: with the friction that was found, and with nominal friction, 8 % off in the base and 7 % in
# the slope.

study.text("conduction", lambda: tables.print_each_at_nominal_friction(shaker))

# %%
# With nominal friction the conduction is negative in runs *j*, *m* and *n*. The thesis rejects the
# same runs, because :math:`\theta_{16} < 0`. In fast, short cycles at low pressure little heat is
# exchanged, and a friction error of a few newtons looks like heat. Run *n* says almost nothing
# about the conduction, even with the friction that was found.
