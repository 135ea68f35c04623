"""Which parameter values fit, and how sure is that, at a point."""

from bayesoleo.error_models.independent import (
    log_likelihood,
    output_counts,
    staged_variance,
    sums_of_squares,
)
from bayesoleo.estimation.estimators.estimate import estimate, polish
from bayesoleo.estimation.estimators.methods import METHODS
from bayesoleo.estimation.estimators.multistart import Modes, multistart
from bayesoleo.estimation.estimators.outcome import Iteration
from bayesoleo.estimation.estimators.point import PointEstimate
from bayesoleo.estimation.estimators.steps import Step
from bayesoleo.estimation.estimators.table import as_text, to_dataset
from bayesoleo.estimation.objectives.objective import (
    OBJECTIVES,
    Objective,
    log_posterior,
    log_prior,
)
from bayesoleo.estimation.problems.campaign_problem import CampaignProblem
from bayesoleo.estimation.problems.function_problem import FunctionProblem
from bayesoleo.estimation.problems.problem import Evaluation, Misfit, Problem
from bayesoleo.estimation.runs.hierarchy import Hierarchy, between_runs
from bayesoleo.estimation.runs.identifiability import data_against_prior
from bayesoleo.estimation.runs.nuisance import Nuisance, declared_nuisance
from bayesoleo.estimation.runs.per_run import estimate_each
from bayesoleo.estimation.sensitivity.analyse import global_sensitivity, local_sensitivity, sobol
from bayesoleo.estimation.shown import LabelledResult
from bayesoleo.estimation.trajectories.multiple_shooting import (
    EstimatedTrajectory,
    ShootingEstimate,
    multiple_shooting,
)
from bayesoleo.estimation.uncertainty.axes import principal_axes
from bayesoleo.estimation.uncertainty.indifference import indifference
from bayesoleo.estimation.uncertainty.intervals import (
    linearised_covariance,
    linearised_intervals,
    over_experiments,
)
from bayesoleo.estimation.uncertainty.laplace import mode_covariance
from bayesoleo.estimation.uncertainty.profile import profile
from bayesoleo.estimation.uncertainty.replicate import Replications, estimate_many
from bayesoleo.estimation.uncertainty.sampling_distribution import sampling_distribution

__all__ = [
    "METHODS",
    "OBJECTIVES",
    "CampaignProblem",
    "EstimatedTrajectory",
    "Evaluation",
    "FunctionProblem",
    "Hierarchy",
    "Iteration",
    "LabelledResult",
    "Misfit",
    "Modes",
    "Nuisance",
    "Objective",
    "PointEstimate",
    "Problem",
    "Replications",
    "ShootingEstimate",
    "Step",
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
