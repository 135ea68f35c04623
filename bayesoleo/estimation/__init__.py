"""Which parameter values fit, and how sure is that, at a point."""

from bayesoleo.estimation.estimate import estimate, polish
from bayesoleo.estimation.function_problem import FunctionProblem
from bayesoleo.estimation.hierarchy import Hierarchy, between_runs
from bayesoleo.estimation.iterate import Iteration
from bayesoleo.estimation.laplace import mode_covariance
from bayesoleo.estimation.multistart import Modes, multistart
from bayesoleo.estimation.nuisance import Nuisance, declared_nuisance
from bayesoleo.estimation.objectives import (
    log_likelihood,
    log_posterior,
    log_prior,
    output_counts,
    staged_variance,
    sums_of_squares,
)
from bayesoleo.estimation.per_run import estimate_each
from bayesoleo.estimation.point import PointEstimate
from bayesoleo.estimation.problem import Evaluation, Misfit, Problem
from bayesoleo.estimation.replicate import Replications, estimate_many
from bayesoleo.estimation.steps import METHODS, Step
from bayesoleo.estimation.table import as_text, to_dataset

__all__ = [
    "METHODS",
    "Evaluation",
    "FunctionProblem",
    "Hierarchy",
    "Iteration",
    "Misfit",
    "Modes",
    "Nuisance",
    "PointEstimate",
    "Problem",
    "Replications",
    "Step",
    "as_text",
    "between_runs",
    "declared_nuisance",
    "estimate",
    "estimate_each",
    "estimate_many",
    "log_likelihood",
    "log_posterior",
    "log_prior",
    "mode_covariance",
    "multistart",
    "output_counts",
    "polish",
    "staged_variance",
    "sums_of_squares",
    "to_dataset",
]
