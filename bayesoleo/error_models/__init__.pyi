from ._base import (
    ErrorModel as ErrorModel,
    Frame as Frame,
    Measured as Measured,
    Probit as Probit,
    ProfiledErrorModel as ProfiledErrorModel,
    Quantity as Quantity,
    Residuals as Residuals,
    RunSamples as RunSamples,
)
from ._catalogue_discrepancy import (
    CatalogueErrors as CatalogueErrors,
)
from ._catalogue_evidence import (
    Linearised as Linearised,
)
from ._correlated import (
    CorrelatedErrors as CorrelatedErrors,
    PowerErrors as PowerErrors,
    effective_samples as effective_samples,
)
from ._discrepancy import (
    DiscrepancyErrors as DiscrepancyErrors,
    SharedDiscrepancyErrors as SharedDiscrepancyErrors,
    basis as basis,
    spectrum as spectrum,
)
from ._full import (
    FullErrors as FullErrors,
    GivenErrors as GivenErrors,
)
from ._independent import (
    IndependentErrors as IndependentErrors,
    PerRunErrors as PerRunErrors,
    log_likelihood as log_likelihood,
    output_counts as output_counts,
    staged_variance as staged_variance,
)
from ._registry import (
    ERROR_MODELS as ERROR_MODELS,
    error_model as error_model,
)
from ._signatures import (
    Signatures as Signatures,
)
from ._spectral import (
    SpectralErrors as SpectralErrors,
)
from ._stretch import (
    Stretch as Stretch,
)
