from ._adaptive_mesh import (
    AdaptiveSolution as AdaptiveSolution,
    AdaptiveStart as AdaptiveStart,
    solve_adaptive as solve_adaptive,
)
from ._branches import (
    BorderedSolution as BorderedSolution,
    Branch as Branch,
    BranchPoint as BranchPoint,
    LimitCycle as LimitCycle,
    SpecialPoint as SpecialPoint,
)
from ._collocation import (
    Collocation as Collocation,
    SamplePlan as SamplePlan,
)
from ._initial_value import (
    DenseTrajectory as DenseTrajectory,
    Dynamics as Dynamics,
)
from ._mesh import (
    Mesh as Mesh,
    Tableau as Tableau,
)
from ._moving_edges import (
    Warp as Warp,
)
from ._orbit import (
    Orbit as Orbit,
    Status as Status,
)
from ._periodic import (
    Boundary as Boundary,
    Solution as Solution,
    solve_from_guess as solve_from_guess,
    solve_periodic as solve_periodic,
)
from ._schemes import (
    Scheme as Scheme,
)
from ._shooting import (
    Shot as Shot,
    solve_shooting as solve_shooting,
)
from ._switched import (
    Crossings as Crossings,
    Level as Level,
    PeriodicProblem as PeriodicProblem,
    Switches as Switches,
)
from ._switching import (
    InputSignal as InputSignal,
)
from ._unrolled_program import (
    Program as Program,
)
