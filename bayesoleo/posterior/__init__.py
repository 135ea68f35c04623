"""Which parameter values fit, as a density: the sampled posterior of parameters and variances."""

from bayesoleo.posterior.comparison import compare, comparison_text
from bayesoleo.posterior.density import LogDensity
from bayesoleo.posterior.diagnostics import Comparison, compare_with_point
from bayesoleo.posterior.error_models import ERROR_MODELS, error_model
from bayesoleo.posterior.hierarchy import hierarchical
from bayesoleo.posterior.importance import Weighted, importance_sample
from bayesoleo.posterior.laplace import Mode, find_mode, laplace_mixture
from bayesoleo.posterior.mixture import Mixture
from bayesoleo.posterior.predictive import choose_draws
from bayesoleo.posterior.prior_sensitivity import prior_sensitivity
from bayesoleo.posterior.sample import sample
from bayesoleo.posterior.samples import Samples
from bayesoleo.posterior.tree import to_datasets

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
