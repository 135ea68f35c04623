"""A session in Python: objects that show themselves, from a campaign to what its model lacks.

``load_campaign`` → ``Problem`` → ``Fit`` → ``Posterior`` or ``Explanation``. A user's function goes
the same way as a campaign and a model.
"""

from bayesoleo.session.campaign import Campaign, load_campaign
from bayesoleo.session.problem import Check, Problem
from bayesoleo.session.results import Explanation, Fit, Posterior, load_result
from bayesoleo.session.shown import Result

__all__ = [
    "Campaign",
    "Check",
    "Explanation",
    "Fit",
    "Posterior",
    "Problem",
    "Result",
    "load_campaign",
    "load_result",
]
