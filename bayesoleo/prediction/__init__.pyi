from ._branches import (
    follow_branch as follow_branch,
    limit_cycle as limit_cycle,
)
from ._inputs import (
    dynamics_of as dynamics_of,
)
from ._orbits import (
    PeriodicOrbits as PeriodicOrbits,
    periodic_orbit as periodic_orbit,
)
from ._periodic_run import (
    RunPredictor as RunPredictor,
)
from ._periodic_solver import (
    periodic_problem as periodic_problem,
)
from ._predictor import (
    Predictor as Predictor,
)
from ._records import (
    Record as Record,
    transient_record as transient_record,
)
from ._simulate import (
    RunPlan as RunPlan,
    Simulation as Simulation,
    motion as motion,
    record_of as record_of,
    simulate_run as simulate_run,
)
