from ._batched_fits import (
    Replications as Replications,
    estimate_many as estimate_many,
)
from ._bayesian_estimators import (
    METHODS as METHODS,
    Step as Step,
)
from ._between_runs import (
    Hierarchy as Hierarchy,
    between_runs as between_runs,
)
from ._campaign_problem import (
    CampaignProblem as CampaignProblem,
)
from ._estimate import (
    estimate as estimate,
    polish as polish,
)
from ._function_problem import (
    FunctionProblem as FunctionProblem,
)
from ._identifiability import (
    Modes as Modes,
    data_against_prior as data_against_prior,
    multistart as multistart,
    principal_axes as principal_axes,
)
from ._indifference_regions import (
    indifference as indifference,
)
from ._intervals import (
    linearised_covariance as linearised_covariance,
    linearised_intervals as linearised_intervals,
    mode_covariance as mode_covariance,
    over_experiments as over_experiments,
)
from ._iteration import (
    Iteration as Iteration,
)
from ._least_squares import (
    BatchNormalEquations as BatchNormalEquations,
    BatchProblem as BatchProblem,
    WhitenedEquations as WhitenedEquations,
)
from ._multiple_shooting import (
    EstimatedTrajectory as EstimatedTrajectory,
    ShootingEstimate as ShootingEstimate,
    multiple_shooting as multiple_shooting,
)
from ._nuisance import (
    Nuisance as Nuisance,
    declared_nuisance as declared_nuisance,
)
from ._objectives import (
    OBJECTIVES as OBJECTIVES,
    Objective as Objective,
    log_posterior as log_posterior,
    log_prior as log_prior,
)
from ._per_run import (
    estimate_each as estimate_each,
)
from ._point_estimate import (
    PointEstimate as PointEstimate,
    to_dataset as to_dataset,
)
from ._problem import (
    EstimationProblem as EstimationProblem,
    Evaluation as Evaluation,
    Misfit as Misfit,
)
from ._profile_likelihood import (
    profile as profile,
)
from ._sampling_distribution import (
    sampling_distribution as sampling_distribution,
)
from ._sensitivity import (
    global_sensitivity as global_sensitivity,
    local_sensitivity as local_sensitivity,
    sobol as sobol,
)
