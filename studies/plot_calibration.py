"""
Do intervals cover?
===================

A 90 % interval should hold the truth in nine experiments of ten. Whether sampler and density are
right can be tested: draw the truth from the prior, simulate, sample the posterior, and rank the
truth among its draws. Over many replications the ranks are uniform (simulation-based calibration,
Talts et al. 2018). Whether the *model* is right cannot be tested so, and where an effect is missing
intervals promise too much: the second half of this page counts how much.
"""

# %%
# Replications take long; the tables are those of the commands that they name.

import calibration_figures as figures

for name in ("spring", "oleo", "oleo-weighted", "coverage"):
    stored = figures.stored(name)
    print(f"{name:14}", stored["command"] if stored else "not run yet", sep="  ")

# %%
# Ranks
# -----
#
# The part of the ranks up to a place, less that of a uniform variable. A curve that stays inside
# its band is what chance makes of a right posterior; one that leans has a bias, one that is bent
# twice has the wrong width. First the gas spring: its exponent and the logarithm of its variance.

figure = figures.ranks_figure("spring")

# %%
# The same of seven parameters and two variances of an oleo, four runs of a shaker campaign.

figure = figures.ranks_figure("oleo")

# %%
# Each band holds 95 % of uniform ranks, so of nine quantities one or none may leave theirs by
# chance. Of the first 300 of these experiments the variance of the pressure did (p = 0.003); twice
# as many tell chance from a mistake. Weighted draws
# (:func:`~bayesoleo.posterior.importance_sample`) cost a tenth; of the same experiments and more,
# they test the density where walkers test the sampler too.

figures.print_ranks()
figure = figures.ranks_figure("oleo-weighted")

# %%
# An effect that nobody declared
# ------------------------------
#
# Parameters, the effect and its size are drawn anew in each replication: direction-dependent
# damping, a linear stiffness, Stribeck friction or a wall that stores heat, one as likely as
# another, of a size of half to four times the noise (rms of what it changes, in the output that
# shows it most; uniform in the logarithm). The posterior knows nothing of the effect.
#
# What can one ask of it? A parameter whose signature the effect bears stands for the sum of both:
# no assumption on errors tells them apart, and such a parameter does not keep its meaning. Which
# these are the model says, without data: the part of what an effect changes that lies along what
# only this parameter changes, cos² of the angle between them, is compared with that of smooth
# misfits by chance. Left out besides are parameters that an effect redefines: the heat conduction
# of a wall that stores heat, base and slope of a friction with a Stribeck peak.

figures.print_imitation()

# %%
# How often the intervals hold the truth, and what that costs in width:

figures.print_coverage()

# %%
# Filled: parameters that keep their meaning. Open: the others. Errors assumed independent count
# each sample as news. The others know that a residual which stays off is one error and not a
# hundred, and the last that several runs may show one error and not several.
#
# What is left of the misses has two places. Of a linear stiffness the parameters together take over
# 95 % (last column of the table above): an error model learns the size of the misfit from the
# twentieth that is left, and the initial volume is off by more than that. A wall that stores
# heat changes pressure and force as volume and solubility of the gas do, in both outputs at once
# and with no curve that the runs share. What the parameters have taken over is not in the residual,
# and no error model sees it: so it pays to look for the effect first.

figure = figures.coverage_figure()
