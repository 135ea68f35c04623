"""From a campaign folder and a model to results: the verbs that the command line and scripts call.

In the order in which a user meets them: ``reduce`` and ``check`` (:mod:`~bayesoleo.workflow.task`),
``estimate`` and ``estimate_each``, ``sample``, ``trace`` and ``close``, ``propose``, ``simulate``.
"""

from bayesoleo.workflow.closing import close as close
from bayesoleo.workflow.closing import trace as trace
from bayesoleo.workflow.estimating import estimate as estimate
from bayesoleo.workflow.estimating import estimate_each as estimate_each
from bayesoleo.workflow.proposing import propose as propose
from bayesoleo.workflow.sampling import sample as sample
from bayesoleo.workflow.settings import Settings as Settings
from bayesoleo.workflow.simulating import simulate as simulate
from bayesoleo.workflow.task import Source as Source
from bayesoleo.workflow.task import Task as Task
from bayesoleo.workflow.task import check as check
from bayesoleo.workflow.task import choose_drive as choose_drive
from bayesoleo.workflow.task import prepare as prepare
from bayesoleo.workflow.task import reduce as reduce
