"""How a result is shown as figures: each function takes the DataTree and returns one Figure.

Figures are made without pyplot, hence without global state: they can be drawn in threads and on
machines without a display, and are saved with ``figure.savefig(path)``.
"""

from bayesoleo.plots.assessments import assessment
from bayesoleo.plots.branches import branch
from bayesoleo.plots.by_run import by_run
from bayesoleo.plots.corners import corner
from bayesoleo.plots.errors import error
from bayesoleo.plots.fits import fit
from bayesoleo.plots.forecasts import forecast
from bayesoleo.plots.forest import point_against_posterior
from bayesoleo.plots.histories import history
from bayesoleo.plots.pairs import pairs
from bayesoleo.plots.period_search import period_search
from bayesoleo.plots.places import residual_breakdown
from bayesoleo.plots.predictions import predictive
from bayesoleo.plots.prior_sensitivities import prior_sensitivity
from bayesoleo.plots.proposals import proposal
from bayesoleo.plots.rankings import ranking
from bayesoleo.plots.records import records
from bayesoleo.plots.regions import indifference, profile
from bayesoleo.plots.replications import sampling_distribution
from bayesoleo.plots.residual_tests import residual_tests
from bayesoleo.plots.residuals import residual
from bayesoleo.plots.sensitivities import sensitivity
from bayesoleo.plots.traces import trace
from bayesoleo.plots.trajectories import trajectory
from bayesoleo.plots.units import Scale, engineering, format_unit, format_value
from bayesoleo.plots.unnamed_shapes import nonparametric_shape

__all__ = [
    "Scale",
    "assessment",
    "branch",
    "by_run",
    "corner",
    "engineering",
    "error",
    "fit",
    "forecast",
    "format_unit",
    "format_value",
    "history",
    "indifference",
    "nonparametric_shape",
    "pairs",
    "period_search",
    "point_against_posterior",
    "predictive",
    "prior_sensitivity",
    "profile",
    "proposal",
    "ranking",
    "records",
    "residual",
    "residual_breakdown",
    "residual_tests",
    "sampling_distribution",
    "sensitivity",
    "trace",
    "trajectory",
]
