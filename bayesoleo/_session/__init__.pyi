from .campaign import (
    Campaign as Campaign,
    load_campaign as load_campaign,
)
from .display import (
    Result as Result,
)
from .problem import (
    Check as Check,
    Problem as Problem,
)
from .results import (
    Explanation as Explanation,
    Fit as Fit,
    Posterior as Posterior,
    load_result as load_result,
)
