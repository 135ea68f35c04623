from ._band_limited import (
    Smoothed as Smoothed,
)
from ._branches import (
    AnswerBranch as AnswerBranch,
    follow_branch as follow_branch,
    limit_cycle as limit_cycle,
)
from ._filtering import (
    Band as Band,
)
from ._inputs import (
    dynamics_of as dynamics_of,
)
from ._orbits import (
    PeriodicOrbits as PeriodicOrbits,
    periodic_orbit as periodic_orbit,
)
from ._periodic_run import (
    PredictedSamples as PredictedSamples,
    RunPredictor as RunPredictor,
)
from ._periodic_solver import (
    PeriodicMotion as PeriodicMotion,
    periodic_problem as periodic_problem,
)
from ._predictor import (
    Predictor as Predictor,
    RunPrediction as RunPrediction,
)
from ._records import (
    Disturbances as Disturbances,
    Harmonics as Harmonics,
    Record as Record,
    Signal as Signal,
    Tone as Tone,
    transient_record as transient_record,
)
from ._simulate import (
    RunPlan as RunPlan,
    Simulation as Simulation,
    motion as motion,
    record_of as record_of,
    simulate_run as simulate_run,
)
from ._stability import (
    Stability as Stability,
)
