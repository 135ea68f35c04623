from ._adaptive_mesh import (
    solve_adaptive as solve_adaptive,
)
from ._orbit import (
    Status as Status,
)
from ._periodic import (
    solve_from_guess as solve_from_guess,
    solve_periodic as solve_periodic,
)
from ._shooting import (
    solve_shooting as solve_shooting,
)
