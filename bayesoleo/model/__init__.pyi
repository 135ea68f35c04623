from ._correlated_priors import (
    Correlated as Correlated,
    JointNormal as JointNormal,
    sample_of as sample_of,
    with_joint_prior as with_joint_prior,
)
from ._derivatives import (
    Derived as Derived,
)
from ._drive_and_start import (
    driven_by as driven_by,
    possible_drives as possible_drives,
)
from ._kernels import (
    Kernels as Kernels,
    kernels as kernels,
)
from ._model import (
    Model as Model,
)
from ._parameters import (
    Condition as Condition,
    Coordinate as Coordinate,
    Dof as Dof,
    Output as Output,
    Parameter as Parameter,
)
from ._priors import (
    LogNormal as LogNormal,
    LogUniform as LogUniform,
    Normal as Normal,
    Prior as Prior,
    Shape as Shape,
    Transform as Transform,
    Transforms as Transforms,
    TruncatedNormal as TruncatedNormal,
    Uniform as Uniform,
)
