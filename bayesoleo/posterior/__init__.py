"""Which parameter values fit, as a density: the sampled posterior of parameters and variances."""

from bayesoleo.error_models import ERROR_MODELS, error_model
from bayesoleo.posterior.approximation.importance import Weighted, importance_sample
from bayesoleo.posterior.approximation.laplace import Mode, find_mode, laplace_mixture
from bayesoleo.posterior.approximation.mixture import Mixture
from bayesoleo.posterior.density.hierarchy import hierarchical
from bayesoleo.posterior.density.log_density import LogDensity
from bayesoleo.posterior.outcome.comparison import compare, comparison_text
from bayesoleo.posterior.outcome.predictive import choose_draws
from bayesoleo.posterior.outcome.prior_sensitivity import prior_sensitivity
from bayesoleo.posterior.outcome.tree import to_datasets
from bayesoleo.posterior.sampling.diagnostics import Comparison, compare_with_point
from bayesoleo.posterior.sampling.sample import sample
from bayesoleo.posterior.sampling.samples import Samples

__all__ = [
    "ERROR_MODELS",
    "Comparison",
    "LogDensity",
    "Mixture",
    "Mode",
    "Samples",
    "Weighted",
    "choose_draws",
    "compare",
    "compare_with_point",
    "comparison_text",
    "error_model",
    "find_mode",
    "hierarchical",
    "importance_sample",
    "laplace_mixture",
    "prior_sensitivity",
    "sample",
    "to_datasets",
]
