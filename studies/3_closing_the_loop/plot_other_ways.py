r"""
Comparison with SINDy, a force surface and a Gaussian process
=============================================================

A residual can be learned without asking what it is: by a polynomial surface over position and
velocity, by sparse regression on a library of terms (SINDy), by a Gaussian process. Here each gets
the same residual as the closed loop, and is judged on the same runs that were not used.
"""

# %%
# The first two sets are simulated campaigns of an oleo, each with one effect that the model
# ``f16n2d2`` lacks: a **breakaway** friction (Stribeck), which is a function of velocity, and the
# heat capacity of the **wall**, which is a function of what happened before. Fourteen runs each,
# three held out. The third is measured.
#
# Each way gets its fair best. The *surface* (Masri and Caughey, 1979) may take any degree up to
# nine and squeeze the velocity about its zero. *SINDy* (Brunton, Proctor and Kutz, 2016, by
# ``pysindy``) gets polynomials of third order in position, velocity and pressure, smooth signs of
# the velocity of four widths, also times the pressure, and any threshold. The *Gaussian process*
# (Kennedy and O'Hagan, 2001, by ``scikit-learn``) gets its lengths and noise by marginal
# likelihood, and may squeeze the velocity too. What is to be chosen is chosen on the fitted runs
# alone.
#
# ``rms`` is that of the force residual over the noise of a sample (of the measured set in newton as
# well), ``repeating`` that of its average over the periods over the noise of that average: both are
# one where nothing is left.

import bayesoleo
from bayesoleo.plots import Study

print(bayesoleo.system("f16n2d2").name, "and what it lacks")

OPTIONS = {"slow": True, "needs": ("other_ways",)}
breakaway = Study("other_ways_breakaway", data="campaigns/shaker-breakaway", **OPTIONS)
ways = breakaway.helper("other_ways")
friction = breakaway.run(lambda: ways.measure(breakaway.folder, "f16n2d2"))
breakaway.text("table", lambda: ways.print_table("breakaway", friction))

# %%
# A friction is a function of the velocity, so that every way that is given the velocity on the
# right scale can learn it, and predicts nearly as well as the loop does. What it says of the cause
# is another matter: coefficients, terms that stand in for the law, or a length over which the
# surface varies. The loop names the law, with its size and its speed in physical units. The data
# were made with 140 N that decay over 6 mm/s. The catalogue's law multiplies its size by the smooth
# sign of the model's own friction, which at such speeds stays below one, and its size comes out
# larger: the interval is that of noise, not of the shape of a law.

wall = Study("other_ways_wall", data="campaigns/shaker-wall", **OPTIONS)
heat = wall.run(lambda: ways.measure(wall.folder, "f16n2d2"))
wall.text("table", lambda: ways.print_table("wall", heat))

# %%
# The heat that a wall stores depends on the past. No function of the present position, velocity
# and pressure equals it: what these ways learn goes along with it in the fitted runs, and helps
# little in the others, or makes their error larger. An effect may bring a state of its own, and
# the loop finds the right one. The data were made with 1.50 W/K, that is 0.667 K/W, and 12.0 J/K,
# which is 8.0 s.
#
# The **measured** set is a gas-charged damper on a crank table, against a viscous model whose force
# has an unknown offset in every run. Runs 1 and 5 are fitted, 3 and 7 held out; the offset of these
# is estimated on what each way leaves, alike for all. What is missing is friction with memory and a
# gas spring. Nobody knows the truth here, and no way reaches the noise.

damper = Study("other_ways_damper", data="measured/mr_damper", **OPTIONS)
measured = damper.run(lambda: ways.measure(*ways.measured_damper()))
damper.text("table", lambda: ways.print_table("mr_damper", measured))

# %%
# All three beside each other.

figure = damper.figure(
    "bars", lambda: ways.draw({"breakaway": friction, "wall": heat, "mr_damper": measured})
)

# %%
# With ``BAYESOLEO_STORE_FIGURES=1`` this page runs anew, and ``python studies/other_ways.py
# --json`` prints the numbers alone. ``pysindy`` and ``scikit-learn`` come with the dependency
# group ``bench``; a way that is not installed is left out.
