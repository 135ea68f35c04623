from ._assess import (
    assess as assess,
)
from ._residual_breakdown import (
    Series as Series,
    residual_breakdown as residual_breakdown,
    series_of_problem as series_of_problem,
    series_of_tree as series_of_tree,
)
from ._residual_tests import (
    Dependence as Dependence,
    PredictiveScore as PredictiveScore,
    ResidualTest as ResidualTest,
    autocorrelation as autocorrelation,
    autocorrelation_time as autocorrelation_time,
    dependence as dependence,
    intraclass_correlation as intraclass_correlation,
    lack_of_fit as lack_of_fit,
    normality as normality,
    outliers as outliers,
    runs_of_signs as runs_of_signs,
    score_draws as score_draws,
    score_normal as score_normal,
)
