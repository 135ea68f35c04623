from ._oleo import (
    SHAKER_RUNS as SHAKER_RUNS,
    TABLE_6_2 as TABLE_6_2,
    TABLE_6_5 as TABLE_6_5,
    TABLE_6_7 as TABLE_6_7,
    ShakerRun as ShakerRun,
    drop_test as drop_test,
)
from ._systems import (
    describe as describe,
    equations as equations,
    equations_latex as equations_latex,
    system as system,
    systems as systems,
)
