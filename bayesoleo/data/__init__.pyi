from ._campaign import (
    CampaignData as CampaignData,
    SimulatedRun as SimulatedRun,
    dataset_folder as dataset_folder,
    load_campaign as load_campaign,
    write_campaign as write_campaign,
)
from ._campaign_toml import (
    Channel as Channel,
)
from ._data_warnings import (
    Drift as Drift,
    data_warnings as data_warnings,
    drift as drift,
    frequency_warnings as frequency_warnings,
)
from ._fourier import (
    HarmonicBasis as HarmonicBasis,
)
from ._frequency_response import (
    frequency_response as frequency_response,
)
from ._harmonics import (
    SpectralLine as SpectralLine,
    significant_harmonics as significant_harmonics,
)
from ._noise import (
    LocalAverage as LocalAverage,
    NoiseSpectrum as NoiseSpectrum,
    PeriodicAverage as PeriodicAverage,
    periodic_average as periodic_average,
)
from ._reduction import (
    ReducedCampaign as ReducedCampaign,
    on_grid as on_grid,
    reduce_campaign as reduce_campaign,
)
from ._residual_time_shift import (
    Frequency as Frequency,
    PeriodSearch as PeriodSearch,
    autocovariance as autocovariance,
    find_frequency as find_frequency,
    period_search as period_search,
    residual_time_shift as residual_time_shift,
)
from ._run_samples import (
    Run as Run,
)
