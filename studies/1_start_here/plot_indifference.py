r"""
Parameters that data cannot tell apart
======================================

A good fit says that one parameter vector explains the data. It does not say that no other does. The
*indifference region* (Verbeek 1993, eq. 2.43) holds all that fit about as well. This page draws it
for a gas spring, exactly and by Taylor's second order, and lets the sloppy direction name itself.
"""

# %%
# The spring's pressure is :math:`p = p_0 (1 - A x / V)^{-n}`. Piston area :math:`A` and gas volume
# :math:`V` appear as a quotient only: that they cannot be told apart can be seen in the formula.
# That :math:`p_0` and :math:`n` nearly trade off over a short stroke cannot.

import numpy as np
import xarray as xr

from bayesoleo import plots
from bayesoleo.estimation import (
    FunctionProblem,
    estimate,
    indifference,
    polish,
    principal_axes,
    profile,
)
from bayesoleo.model import Normal
from bayesoleo.posterior import (
    LogDensity,
    compare,
    comparison_text,
    laplace_mixture,
    sample,
    to_datasets,
)

NAMES = ["pressure", "exponent", "area", "volume"]
TRUTH = np.array([4.9, 1.1, 3.5, 9.2])  # bar, 1, 1e-3 m², 1e-4 m³
PRIORS = [Normal(4.9, 0.5), Normal(1.2, 0.15), Normal(3.5, 0.35), Normal(9.2, 0.9)]


def spring(stroke, theta):
    pressure, exponent, area, volume = theta
    with np.errstate(invalid="ignore"):  # no gas is left: the estimator is told so by NaN
        return pressure * (1 - 10 * area * stroke / volume) ** -exponent


stroke = np.linspace(0.0, 0.12, 60)
measured = spring(stroke, TRUTH) + np.random.default_rng(2).normal(0.0, 0.05, stroke.size)
problem = FunctionProblem(spring, stroke, measured, PRIORS, NAMES)
point = polish(problem, estimate(problem))
print(point)

# %%
# The curvature of the likelihood, with every parameter in units of its prior's standard deviation,
# has principal axes. Information below one means that the data say less about a direction than the
# prior does.

print(principal_axes(problem, point))

# %%
# Relative to the values a direction is a product of powers. Area and volume have opposite exponents
# in what is known and equal ones in what is not: the quotient is measured, the product is not.

print(principal_axes(problem, point, scale="value"))

# %%
# Contours where the log posterior has fallen by 3: the profiled ones are the 95 % regions of their
# two parameters. In solid lines the exact region, in dashed ones the ellipse of the curvature. The
# conditional section, with the other parameters held, is what a single plane of the objective
# shows, and is far too optimistic.

region = indifference(
    problem,
    point,
    [("area", "volume"), ("pressure", "exponent"), ("exponent", "volume")],
    points=36,
)
figure = plots.indifference(region.data)

# %%
# Along single parameters the same is told by profiles. Those of the *likelihood* leave area and
# volume open: nothing but the prior bounds them.

by_data = profile(problem, estimate(problem), ["pressure", "exponent", "area"], kind="likelihood")
print(by_data)
figure_profile = plots.profile(by_data.data)

# %%
# **And the posterior?** A region of equal fit is not a credible region: it says how far the
# objective falls, not how much is inside. For a normal posterior the profiled region of a fall of 3
# holds 95 % in each plane of two parameters. Where the posterior is skewed or bent it need not; the
# draws tell.

density = LogDensity(problem)
draws = sample(
    density,
    laplace_mixture(density, point.theta[None]),
    effective_size=2000,
    seed=0,
    progress=False,
)
groups = to_datasets(draws, PRIORS, density=density)
groups |= {"point": point.to_dataset(), "indifference": region.data}
tree = xr.DataTree.from_dict(groups)
figure_pairs = plots.pairs(tree)

# %%
# The table of every result, ``compare``: the posterior's mean against the estimate, its width
# against the linearised covariance and against the region's extent, and its skewness. One by one
# the parameters are as good as normal. Together they are not: the last line compares variances over
# all directions, and across the narrow ridge, along the best known axis, draws lie wider than its
# ellipse, because the ridge is bent.

print(comparison_text(compare(tree)))
