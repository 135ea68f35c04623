r"""
Comparison with SINDy, a force surface and a Gaussian process
=============================================================

A residual can also be learned without a physical law: by a polynomial surface over position and
velocity, by sparse regression on a library of terms (SINDy), or by a Gaussian process. Here each
method gets the same residual as bayesoleo, and is judged on the same held-out runs.
"""

# %%
# **A small version**: the demonstration campaign, an oleo with a friction effect that its model
# lacks. A polynomial surface learns the force residual of the fitted runs from position and
# velocity. ``explain`` chooses between three physical effects.

# sphinx_gallery_thumbnail_number = -1
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import bayesoleo as bo
from bayesoleo.effects import find_effect
from bayesoleo.gallery import Study
from bayesoleo.plots import AFTER, BEFORE

campaign = bo.Campaign.demo(Path(tempfile.mkdtemp()) / "campaign")
effects = [find_effect(n) for n in ("stribeck_friction", "linear_stiffness", "viscous_damping")]
found = bo.Problem(campaign, "f16n2d2").fit().explain(effects=effects, max_effects=1)
print(found.effects, found.verdict)


def stacked(role, *names):
    """Join samples of all runs of a role; velocity is compressed about zero for the surface."""
    roles = found.tree["constant_data"]["role"]
    data = found.tree["residual"].to_dataset().isel(run=(roles == role).values)
    kept = np.isfinite(data["force_before"].values)
    return [data[name].values[kept] for name in names]


def columns(stroke, velocity, degree=7):
    """Chebyshev polynomials of position and compressed velocity."""
    x, v = stroke / 0.132 - 1.0, np.arcsinh(velocity / 0.005) / np.arcsinh(100.0)
    return np.polynomial.chebyshev.chebvander2d(x, v, [degree, degree])


stroke, velocity, force = stacked("fit", "stroke", "velocity", "force_before")
weights = np.linalg.lstsq(columns(stroke, velocity), force, rcond=1e-6)[0]
stroke, velocity, force, rest = stacked(
    "hold-out", "stroke", "velocity", "force_before", "force_after"
)
surface = columns(stroke, velocity) @ weights
errors = {"model as declared": force, "polynomial surface": force - surface, "bayesoleo": rest}
rms = {name: np.sqrt(np.mean(values**2)) for name, values in errors.items()}
figure, axes = plt.subplots(figsize=(8, 2.6), layout="constrained")
axes.barh(list(rms), list(rms.values()), color=[BEFORE, "0.75", AFTER])
axes.axvline(20.0, color="k", lw=1)
axes.invert_yaxis()
axes.set_xlabel("rms force error on held-out runs [N]; line: noise of the sensor")
plt.show()

# %%
# Three campaigns
# ---------------
#
# Two campaigns are simulated, each with one effect that the model ``f16n2d2`` lacks: a
# **breakaway** friction (Stribeck), which is a function of velocity, and the heat capacity of the
# **wall**, which is a function of the past. Both have fourteen runs, three of them held out. The
# third is measured.
#
# Each method is used at its best. The *surface* (Masri and Caughey, 1979) has any degree up to nine
# and may compress the velocity about zero. *SINDy* (Brunton, Proctor and Kutz, 2016, by
# ``pysindy``) has polynomials of third order in position, velocity and pressure, smooth signs of
# the velocity of four widths, also times the pressure, and any threshold. The *Gaussian process*
# (Kennedy and O'Hagan, 2001, by ``scikit-learn``) has lengths and noise by marginal likelihood, and
# may compress the velocity too. All choices are made on the fitted runs alone.
#
# ``rms`` is the error of the force over the noise of a sample, and in newton. ``repeating`` is the
# error of its average over periods, over the noise of that average. Both are one if nothing is
# missing.

OPTIONS = {"slow": True, "needs": ("other_ways",)}
breakaway = Study("other_ways_breakaway", data="campaigns/shaker-breakaway", **OPTIONS)
ways = breakaway.helper("other_ways")
friction = breakaway.run(lambda: ways.measure(breakaway.folder, "f16n2d2"))
breakaway.text("table", lambda: ways.print_table("breakaway", friction))

# %%
# Friction is a function of velocity. Every method that gets the velocity on a suitable scale can
# learn it, and predicts nearly as well as bayesoleo. But such a method returns coefficients,
# substitute terms or a length scale, not a cause. bayesoleo returns the law, with its size and its
# speed in physical units. The data have 140 N that decay over 6 mm/s. The catalogue's law
# multiplies its size by the smooth sign of the model's own friction, which stays below one at such
# speeds. The estimated size is therefore larger; the interval covers noise, not the shape of a law.

wall = Study("other_ways_wall", data="campaigns/shaker-wall", **OPTIONS)
heat = wall.run(lambda: ways.measure(wall.folder, "f16n2d2"))
wall.text("table", lambda: ways.print_table("wall", heat))

# %%
# The heat that a wall stores depends on the past. It is no function of the present position,
# velocity and pressure. The other methods learn a correlation of the fitted runs, which helps
# little in the held-out runs or makes their error larger. An effect of the catalogue may have a
# state of its own, and bayesoleo finds the right one. The data have 1.50 W/K, that is 0.667 K/W,
# and 12.0 J/K, which is 8.0 s.
#
# The **measured** set is a gas-charged damper on a crank table. Its model is viscous, with an
# unknown force offset in every run. Runs 1 and 5 are fitted, 3 and 7 held out; their offset is
# estimated in the same way for all methods. Friction with memory and a gas spring are missing. The
# truth is unknown, and no method reaches the noise.

damper = Study("other_ways_damper", data="measured/mr_damper", **OPTIONS)
measured = damper.run(lambda: ways.measure(*ways.measured_damper()))
damper.text("table", lambda: ways.print_table("mr_damper", measured))

# %%
# All three campaigns.

figure = damper.figure(
    "bars", lambda: ways.draw({"breakaway": friction, "wall": heat, "mr_damper": measured})
)

# %%
# With ``BAYESOLEO_STORE_FIGURES=1`` this page computes everything again, and ``python
# studies/other_ways.py --json`` prints the numbers alone. ``pysindy`` and ``scikit-learn`` come
# with the dependency group ``bench``; a method that is not installed is left out.
