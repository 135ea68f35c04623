from ._assembly import (
    Assembly as Assembly,
    Option as Option,
    assign as assign,
)
from ._fit import (
    ModelFit as ModelFit,
    Numerics as Numerics,
    fit_model as fit_model,
)
from ._loop import (
    close_loop as close_loop,
)
from ._policy import (
    SearchPolicy as SearchPolicy,
)
from ._scales import (
    scales_of as scales_of,
)
from ._score_tests import (
    Score as Score,
    effective_tests as effective_tests,
    score_all as score_all,
    without_twins as without_twins,
)
from ._state import (
    State as State,
    fit_state as fit_state,
)
