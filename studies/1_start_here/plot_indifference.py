r"""
Parameters that data cannot tell apart
======================================

A good fit shows that one parameter vector explains the data. Others may explain them equally well.
The *indifference region* (Verbeek 1993, eq. 2.43) contains all vectors that fit nearly as well.
This page draws it for a gas spring, exactly and to second order, and finds the direction that the
data determine worst.
"""

# %%
# The spring's pressure is :math:`p = p_0 (1 - A x / V)^{-n}`. Piston area :math:`A` and gas volume
# :math:`V` occur only as a quotient, so the data cannot separate them. The formula does not show
# that :math:`p_0` and :math:`n` nearly compensate each other over a short stroke.

# sphinx_gallery_thumbnail_number = 1
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
    with np.errstate(invalid="ignore"):  # no gas is left: NaN
        return pressure * (1 - 10 * area * stroke / volume) ** -exponent


stroke = np.linspace(0.0, 0.12, 60)
measured = spring(stroke, TRUTH) + np.random.default_rng(2).normal(0.0, 0.05, stroke.size)
problem = FunctionProblem(spring, stroke, measured, PRIORS, NAMES)
point = polish(problem, estimate(problem))
print(point)

# %%
# The curvature of the likelihood, with every parameter in units of its prior's standard deviation,
# has principal axes. If the information of a direction is below one, the data determine it less
# than the prior does.

print(principal_axes(problem, point))

# %%
# Relative to the values, a direction is a product of powers. Area and volume have opposite
# exponents in the well-determined direction and equal ones in the other: the data determine the
# quotient, but not the product.

print(principal_axes(problem, point, scale="value"))

# %%
# Contours where the log posterior has fallen by 3: the profiled ones are the 95 % regions of their
# two parameters. Solid lines are the exact region, dashed lines the ellipse of the curvature. The
# conditional section, with all other parameters held constant, is far too small.

region = indifference(
    problem,
    point,
    [("area", "volume"), ("pressure", "exponent"), ("exponent", "volume")],
    points=36,
)
figure = plots.indifference(region.data)

# %%
# Profiles show the same for single parameters. The profiles of the *likelihood* are open for area
# and volume: only the prior bounds them.

by_data = profile(problem, estimate(problem), ["pressure", "exponent", "area"], kind="likelihood")
print(by_data)
figure_profile = plots.profile(by_data.data)

# %%
# **The posterior.** A region of equal fit is not a credible region: it limits the objective, not
# the probability. For a normal posterior the profiled region of a fall of 3 contains 95 % in each
# plane of two parameters. For a skewed or curved posterior it need not, so draws are compared with
# it.

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
# ``compare`` holds the posterior's mean against the estimate, and its width against the linearised
# covariance and the region. Each parameter alone is nearly normal. All together are not: the last
# line compares variances over all directions. Across the narrow ridge the draws are wider than the
# ellipse, because the ridge is curved.

print(comparison_text(compare(tree)))
