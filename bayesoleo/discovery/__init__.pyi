from ._assembly import (
    AddedEffect as AddedEffect,
    Assembly as Assembly,
    Option as Option,
    RecordNoise as RecordNoise,
    Roles as Roles,
    assign as assign,
)
from ._expected_error import (
    EstimateCovariance as EstimateCovariance,
)
from ._fit import (
    ModelFit as ModelFit,
    fit_model as fit_model,
)
from ._fit_and_hold_out_error import (
    ErrorTable as ErrorTable,
    RunError as RunError,
)
from ._inference import (
    Inference as Inference,
)
from ._loop import (
    ClosedLoop as ClosedLoop,
    close_loop as close_loop,
)
from ._nonparametric_search import (
    CurveSearch as CurveSearch,
    Tried as Tried,
)
from ._numerics import (
    Numerics as Numerics,
)
from ._policy import (
    SearchPolicy as SearchPolicy,
)
from ._ranking import (
    Ranked as Ranked,
    scales_of as scales_of,
)
from ._refit import (
    Inflation as Inflation,
    Refit as Refit,
)
from ._round import (
    Progress as Progress,
    Round as Round,
)
from ._run_predictions import (
    Prediction as Prediction,
)
from ._score_basis import (
    Base as Base,
    RunBase as RunBase,
)
from ._score_tests import (
    Score as Score,
    effective_tests as effective_tests,
    score_all as score_all,
    without_twins as without_twins,
)
from ._spectral_data import (
    RunLines as RunLines,
    SpectralData as SpectralData,
)
from ._state import (
    State as State,
    fit_state as fit_state,
)
from ._structures import (
    AveragedParameter as AveragedParameter,
    Structure as Structure,
    StructurePosterior as StructurePosterior,
    StructurePrior as StructurePrior,
)
