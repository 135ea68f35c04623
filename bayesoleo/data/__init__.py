"""How files become records, and how noise is measured."""

from bayesoleo.data.averaging import PeriodicAverage as PeriodicAverage
from bayesoleo.data.averaging import periodic_average as periodic_average
from bayesoleo.data.campaign import Campaign as Campaign
from bayesoleo.data.campaign import Run as Run
from bayesoleo.data.campaign import load_campaign as load_campaign
from bayesoleo.data.declaration import Channel as Channel
from bayesoleo.data.drift import Drift as Drift
from bayesoleo.data.drift import drift as drift
from bayesoleo.data.drift import record_drifts as record_drifts
from bayesoleo.data.findings import findings as findings
from bayesoleo.data.findings import motions_per_period as motions_per_period
from bayesoleo.data.harmonics import significant_harmonics as significant_harmonics
from bayesoleo.data.mapping import on_grid as on_grid
from bayesoleo.data.period import Frequency as Frequency
from bayesoleo.data.period import autocovariance as autocovariance
from bayesoleo.data.period import find_frequency as find_frequency
from bayesoleo.data.period import residual_time_shift as residual_time_shift
from bayesoleo.data.period_search import PeriodSearch as PeriodSearch
from bayesoleo.data.period_search import period_search as period_search
from bayesoleo.data.reduction import ReducedCampaign as ReducedCampaign
from bayesoleo.data.reduction import reduce_campaign as reduce_campaign
from bayesoleo.data.reduction import reduce_run as reduce_run
from bayesoleo.data.registry import dataset_folder as dataset_folder
from bayesoleo.data.transforms import HarmonicBasis as HarmonicBasis
from bayesoleo.data.writing import SimulatedRun as SimulatedRun
from bayesoleo.data.writing import write_campaign as write_campaign
