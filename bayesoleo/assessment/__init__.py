"""How good an estimate is, by what it leaves and by what it foresees."""

from bayesoleo.assessment.assess import (
    assess,
    assessment_text,
    correlograms,
    dependence_on,
    outliers_of,
)
from bayesoleo.assessment.residual_tests import (
    autocorrelation,
    autocorrelation_time,
    dependence,
    intraclass_correlation,
    lack_of_fit,
    normality,
    outliers,
    runs_of_signs,
)
from bayesoleo.assessment.scores import PredictiveScore, score_draws, score_normal
from bayesoleo.assessment.series import Series, series_of_problem, series_of_tree
from bayesoleo.assessment.whereabouts import residual_breakdown

__all__ = [
    "PredictiveScore",
    "Series",
    "assess",
    "assessment_text",
    "autocorrelation",
    "autocorrelation_time",
    "correlograms",
    "dependence",
    "dependence_on",
    "intraclass_correlation",
    "lack_of_fit",
    "normality",
    "outliers",
    "outliers_of",
    "residual_breakdown",
    "runs_of_signs",
    "score_draws",
    "score_normal",
    "series_of_problem",
    "series_of_tree",
]
