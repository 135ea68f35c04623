from ._comparison import (
    DRAWS as DRAWS,
    compare as compare,
    comparison_text as comparison_text,
    prior_sensitivity as prior_sensitivity,
    rank_of as rank_of,
    uniformity as uniformity,
)
from ._datatree import (
    choose_draws as choose_draws,
    to_datasets as to_datasets,
)
from ._diagnostics import (
    Comparison as Comparison,
    Samples as Samples,
    compare_with_point as compare_with_point,
)
from ._hierarchy import (
    hierarchical as hierarchical,
)
from ._laplace import (
    Mode as Mode,
    Weighted as Weighted,
    find_mode as find_mode,
    importance_sample as importance_sample,
    laplace_mixture as laplace_mixture,
)
from ._log_density import (
    LogDensity as LogDensity,
)
from ._mixture import (
    Mixture as Mixture,
)
from ._sampler import (
    sample as sample,
)
