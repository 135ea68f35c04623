"""Which parameter values fit, as a density: the sampled posterior of parameters and variances."""

from bayesoleo.posterior.density import LogDensity
from bayesoleo.posterior.diagnostics import Comparison, compare_with_point
from bayesoleo.posterior.laplace import Mode, find_mode, laplace_mixture
from bayesoleo.posterior.mixture import Mixture
from bayesoleo.posterior.predictive import choose_draws
from bayesoleo.posterior.sample import sample
from bayesoleo.posterior.samples import Samples
from bayesoleo.posterior.tree import to_datasets

__all__ = [
    "Comparison",
    "LogDensity",
    "Mixture",
    "Mode",
    "Samples",
    "choose_draws",
    "compare_with_point",
    "find_mode",
    "laplace_mixture",
    "sample",
    "to_datasets",
]
