"""Which parameter values fit, and how sure is that, at a point."""

from bayesoleo.estimation.axes import principal_axes
from bayesoleo.estimation.estimate import estimate, polish
from bayesoleo.estimation.function_problem import FunctionProblem
from bayesoleo.estimation.hierarchy import Hierarchy, between_runs
from bayesoleo.estimation.identifiability import data_against_prior
from bayesoleo.estimation.indifference import indifference
from bayesoleo.estimation.intervals import (
    linearised_covariance,
    linearised_intervals,
    over_experiments,
)
from bayesoleo.estimation.iterate import Iteration
from bayesoleo.estimation.laplace import mode_covariance
from bayesoleo.estimation.methods import METHODS
from bayesoleo.estimation.multiple_shooting import ShootingEstimate, Trajectory, multiple_shooting
from bayesoleo.estimation.multistart import Modes, multistart
from bayesoleo.estimation.nuisance import Nuisance, declared_nuisance
from bayesoleo.estimation.objective import OBJECTIVES, Objective
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
from bayesoleo.estimation.profile import profile
from bayesoleo.estimation.replicate import Replications, estimate_many
from bayesoleo.estimation.sampling_distribution import sampling_distribution
from bayesoleo.estimation.sensitivity import global_sensitivity, local_sensitivity, sobol
from bayesoleo.estimation.shown import Shown
from bayesoleo.estimation.steps import Step
from bayesoleo.estimation.table import as_text, to_dataset

__all__ = [
    "METHODS",
    "OBJECTIVES",
    "Evaluation",
    "FunctionProblem",
    "Hierarchy",
    "Iteration",
    "Misfit",
    "Modes",
    "Nuisance",
    "Objective",
    "PointEstimate",
    "Problem",
    "Replications",
    "ShootingEstimate",
    "Shown",
    "Step",
    "Trajectory",
    "as_text",
    "between_runs",
    "data_against_prior",
    "declared_nuisance",
    "estimate",
    "estimate_each",
    "estimate_many",
    "global_sensitivity",
    "indifference",
    "linearised_covariance",
    "linearised_intervals",
    "local_sensitivity",
    "log_likelihood",
    "log_posterior",
    "log_prior",
    "mode_covariance",
    "multiple_shooting",
    "multistart",
    "output_counts",
    "over_experiments",
    "polish",
    "principal_axes",
    "profile",
    "sampling_distribution",
    "sobol",
    "staged_variance",
    "sums_of_squares",
    "to_dataset",
]
