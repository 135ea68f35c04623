r"""
Posterior of an end stop's stiffness
====================================

The stiffness of an end stop is seen only while the stop is touched. This page simulates the oleo of
Verbeek (1993, section 4.3.3) with a stop of :math:`\theta = 100` under three forcings, from a hard
blow to one that does not reach it. For each it compares the point estimate of the stiffness, the
posterior, and the influence of the prior.
"""

# %%
# :math:`\ddot q + \dot q |\dot q| + 10 (1 - q)^{-1.2} + k(q)\,q = 23 + A \cos 2 \pi t`, the stroke
# measured over two periods with noise of a hundredth of the stroke. The periodic motion depends on
# the stiffness smoothly; it is computed by the adaptive mesh at 24 stiffnesses and interpolated in
# between, to a hundredth of the noise.

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from scipy import stats
from scipy.interpolate import make_interp_spline

import bayesoleo
from bayesoleo.estimation import FunctionProblem, estimate, polish
from bayesoleo.model import LogNormal
from bayesoleo.plots import BEFORE
from bayesoleo.posterior import (
    LogDensity,
    compare,
    laplace_mixture,
    prior_sensitivity,
    sample,
    to_datasets,
)
from bayesoleo.prediction import RunPlan, motion, periodic_orbit

TRUTH, NOISE, PRIOR = 100.0, 0.01, LogNormal(200.0, 1.0)
phase = np.arange(200) / 100
table = np.exp(np.linspace(np.log(3.0), np.log(15_000.0), 24))
model = bayesoleo.system("end_stop")


def stroke(amplitude):
    """The stroke over two periods as a function of the logarithm of the stiffness."""
    plan = RunPlan("run", 1.0, {"force": motion(23.0, [amplitude])})
    stiffness, options = (
        {"stop_stiffness": table},
        {"tolerance": 1e-6, "stiffness": "stop_stiffness"},
    )
    found = periodic_orbit(model, plan, stiffness, "adaptive", **options)
    return make_interp_spline(np.log(table), found.dof("stroke", phase % 1.0))


def problem_of(amplitude):
    """Measured and assumed; the prior is twice too stiff and wide."""
    curve, rng = stroke(amplitude), np.random.default_rng(3)
    measured = curve(np.log(TRUTH)) + rng.normal(0.0, NOISE, phase.size)
    deepest = curve(np.log(TRUTH)).min()
    return deepest, FunctionProblem(
        lambda _, t: curve(np.log(t[0])), phase, measured, [PRIOR], ["stiffness"]
    )


runs = {}
for amplitude in (20.0, 7.6, 7.45, 7.0):
    deepest, problem = problem_of(amplitude)
    mbe = estimate(problem)
    mode = polish(problem, mbe)
    density = LogDensity(problem)
    start = laplace_mixture(density, mode.theta[None])
    draws = sample(density, start, effective_size=1500, seed=0, progress=False)
    groups = to_datasets(draws, problem.priors, density=density)
    runs[amplitude] = deepest, mbe, xr.DataTree.from_dict({**groups, "point": mode.to_dataset()})

# %%
# The maximum of the likelihood (MBE) with its linearised standard deviation, and the posterior.
# *Into the stop* is how far the stroke goes there, over the noise of a sample. The sensitivity is
# the shift of the posterior if the prior counts double (Kallioinen et al. 2024). Above 0.05 it is
# noteworthy.

print("forcing  into the stop        MBE     sd   posterior  95 % interval  skewness  sensitivity")
print(f"{'':55}{'':17}of k  of ln k  to prior")
for amplitude, (deepest, mbe, tree) in runs.items():
    k = tree["posterior"]["stiffness"].values.ravel()
    low, middle, high = np.quantile(k, [0.025, 0.5, 0.975])
    lean = float(prior_sensitivity(tree)["prior"].sel(quantity="stiffness"))
    print(
        f"{amplitude:7.2f}{max(-deepest, 0) / NOISE:12.1f}{mbe.theta[0]:13.1f}{mbe.sd[0]:8.1f}"
        f"{middle:10.0f}{low:10.0f} to{high:6.0f}"
        f"{stats.skew(k):7.2f}{stats.skew(np.log(k)):8.2f}{lean:10.3f}"
    )

# %%
# A hard blow determines the stiffness to a per cent, and estimate and posterior agree. If the
# stroke ends less than one standard deviation of the noise inside the stop, half the stiffness
# would be visible in the data, twice the stiffness hardly. The posterior is skewed to the stiff
# side, and a symmetric interval is wrong on both sides. The logarithm of the stiffness is nearly
# symmetric, so a stiffness is better stated on that scale. If the stop is not reached, the
# posterior is the prior, and the estimate stays at its start.

figure, panels = plt.subplots(2, 4, figsize=(10, 4.6), layout="constrained")
for (upper, lower), (amplitude, (deepest, mbe, tree)) in zip(panels.T, runs.items(), strict=True):
    k, point, sd = tree["posterior"]["stiffness"].values.ravel(), mbe.theta[0], mbe.sd[0]
    low, high = np.quantile(k, [0.002, 0.985])
    low, high = (low, high) if amplitude > 7 else (0.0, 1200.0)
    fine = np.linspace(low, high, 300)
    upper.hist(k, 45, range=(low, high), density=True, color="#8cbbd9", label="posterior")
    upper.plot(fine, stats.norm.pdf(fine, point, sd), color=BEFORE, label="point, linearised")
    prior = np.exp(PRIOR.log_density(fine[fine > 0]))
    upper.plot(fine[fine > 0], prior, "--", color="0.5", lw=1, label="prior")
    upper.axvline(TRUTH, color="k", lw=0.8, label="truth")
    upper.set(xlim=(low, high), xlabel="stiffness k", yticks=[])
    upper.set_title(f"A = {amplitude:g}: {max(-deepest, 0) / NOISE:.1f} sd deep", fontsize=9)
    log_low, log_high = np.log(np.quantile(k, [0.001, 0.999]))
    fine = np.linspace(log_low, log_high, 300)
    lower.hist(np.log(k), 45, range=(log_low, log_high), density=True, color="#8cbbd9")
    on_log = stats.norm.pdf(fine, np.log(point), sd / point)
    lower.plot(fine, on_log, color=BEFORE)
    lower.plot(
        fine, stats.norm.pdf(fine, np.log(PRIOR.median), PRIOR.log_spread), "--", color="0.5", lw=1
    )
    lower.axvline(np.log(TRUTH), color="k", lw=0.8)
    lower.set(xlim=(log_low, log_high), xlabel="ln k", yticks=[])
panels[0, 2].legend(frameon=False, fontsize=7)

# %%
# The table that every result holds, ``compare``: shift of the posterior's mean from the estimate
# (here the mode), its width over the linearised one, and skewness.

for amplitude, (_, _, tree) in runs.items():
    found = compare(tree)
    numbers = found["shift"].item(), found["sd_ratio"].sel(reference="linearised").item()
    print(f"A = {amplitude:5.2f}: shift {numbers[0]:6.2f} sd, width {numbers[1]:5.2f}")
