from ._catalogue import (
    called as called,
    candidates as candidates,
    catalogue as catalogue,
    describe as describe,
    find_effect as find_effect,
)
from ._effect import (
    FAMILIES as FAMILIES,
    Candidate as Candidate,
    Effect as Effect,
)
from ._forces import (
    InternalState as InternalState,
    force_effect as force_effect,
)
from ._nonparametric import (
    Axis as Axis,
    NonparametricEffect as NonparametricEffect,
    Spline as Spline,
)
from ._parts import (
    Amplitude as Amplitude,
    Constant as Constant,
    Scales as Scales,
    Scan as Scan,
    ShapeParameter as ShapeParameter,
    velocity_grid as velocity_grid,
)
