from ._discovery import (
    nonparametric_shape as nonparametric_shape,
    proposal as proposal,
    ranking as ranking,
    structures as structures,
)
from ._estimates import (
    history as history,
    indifference as indifference,
    prior_sensitivity as prior_sensitivity,
    profile as profile,
    sampling_distribution as sampling_distribution,
    sensitivity as sensitivity,
)
from ._posterior import (
    corner as corner,
    pairs as pairs,
    point_against_posterior as point_against_posterior,
    trace as trace,
)
from ._predictions import (
    branch as branch,
    forecast as forecast,
    predictive as predictive,
    trajectory as trajectory,
)
from ._residuals import (
    assessment as assessment,
    residual as residual,
    residual_breakdown as residual_breakdown,
    residual_tests as residual_tests,
)
from ._runs import (
    by_run as by_run,
    error as error,
    fit as fit,
    frequency_response as frequency_response,
    period_search as period_search,
    records as records,
)
from ._style import (
    AFTER as AFTER,
    BEFORE as BEFORE,
    INK as INK,
    SIMILAR as SIMILAR,
    format_number as format_number,
)
