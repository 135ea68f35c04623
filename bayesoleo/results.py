"""What the steps of a session return besides the objects of the root.

They are made by methods and functions, not by hand; their names serve annotations and
``isinstance``.
"""

from __future__ import annotations

from bayesoleo._schema import LabelledResult
from bayesoleo._session.display import Result
from bayesoleo._session.problem import Check
from bayesoleo._workflow import EachResult, EachTask

__all__ = ["Check", "EachResult", "EachTask", "LabelledResult", "Result"]
