from .closing import (
    close as close,
    propose as propose,
    trace as trace,
)
from .each import (
    EachResult as EachResult,
    close_each as close_each,
)
from .each_task import (
    EachTask as EachTask,
)
from .estimating import (
    estimate as estimate,
    estimate_each as estimate_each,
    sample as sample,
)
from .predicting import (
    predict as predict,
)
from .settings import (
    Settings as Settings,
)
from .simulating import (
    simulate as simulate,
)
from .task import (
    Source as Source,
    Task as Task,
    check as check,
    choose_drive as choose_drive,
    prepare as prepare,
    reduce as reduce,
)
