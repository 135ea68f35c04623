from ._comparison import (
    DRAWS as DRAWS,
    BayesBag as BayesBag,
    Uniformity as Uniformity,
    bayesbag as bayesbag,
    compare as compare,
    comparison_text as comparison_text,
    prior_sensitivity as prior_sensitivity,
    rank_of as rank_of,
    uniformity as uniformity,
)
from ._datatree import (
    to_datasets as to_datasets,
)
from ._diagnostics import (
    Samples as Samples,
)
from ._ensemble_moves import (
    MoveWeights as MoveWeights,
)
from ._hierarchy import (
    HierarchicalUnknowns as HierarchicalUnknowns,
    Population as Population,
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
    Density as Density,
    LogDensity as LogDensity,
    PlainUnknowns as PlainUnknowns,
    Unknowns as Unknowns,
)
from ._mixture import (
    Mixture as Mixture,
)
from ._sampler import (
    sample as sample,
)
