"""The problem of a session: a campaign and a model, or a table and a function."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any

from bayesoleo import data as measured
from bayesoleo._session.campaign import (
    DELAY,
    Campaign,
    CampaignWork,
    changed,
    check_text,
    status_line,
)
from bayesoleo._session.display import Showing, kept
from bayesoleo._session.function_work import (
    FunctionWork,
    arguments_of,
    call_of,
    check_call,
    output_of,
    parameters_of,
    read_table,
)
from bayesoleo._session.results import Fit
from bayesoleo._workflow.model_files import load_model
from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import prepare
from bayesoleo.data._reduction import ReducedCampaign
from bayesoleo.errors import InputError
from bayesoleo.model._model import Model


class Check(Showing):
    """A summary of a problem before it is fitted, with warnings.

    Parameters
    ----------
    facts : dict
        By name.
    """

    def __init__(self, facts: dict[str, Any]) -> None:
        self.facts = facts

    @property
    def data_warnings(self) -> list[str]:
        """Sentences about records and start that deserve a look."""
        return list(self.facts.get("data_warnings", []))

    def _text(self) -> str:
        return check_text(self.facts)


class Problem(Showing):
    """Data and what should explain them, ready to be fitted.

    Parameters
    ----------
    data : Campaign, path-like or table
        A campaign, or its folder; or for a function a table: a dictionary of columns, a pandas
        table or an xarray Dataset.
    model : Model, str, path-like or callable
        A model, the name of a built-in one, or a file (``model.py:model``); or a function. Its
        arguments are columns and parameters, ``f(x, a, b)``, or its last argument is a vector of
        all parameters that are estimated, ``f(x, theta)``: the names decide.
    parameters : mapping of str to Parameter or Prior, optional
        Of a function. A prior stands for a parameter that starts at its mean.
    output : str, optional
        The measured column of a table; by default ``y``, or the only one that is no argument.
    settings : Settings, optional
        Of all later steps.
    progress : bool
        Whether to show a bar while runs are reduced, if that takes more than two seconds.
    **keywords
        Single settings, as ``drive="force"``; see :class:`Settings`.

    Raises
    ------
    InputError
        If data and model do not fit together; it says which key, which value, and what to write.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesoleo import Parameter
    >>> x = np.linspace(0.0, 1.0, 20)
    >>> parameters = {"a": Parameter(1.0, sd=10.0), "b": Parameter(0.0, sd=10.0)}
    >>> Problem({"x": x, "y": 3 * x + 1}, lambda x, a, b: a * x + b, parameters=parameters)
    y = <lambda>(x, …)
    20 samples of x, y
    parameter  start  sd of prior  unit
    a              1           10     1
    b              0           10     1
    """

    def __init__(
        self,
        data: Any,
        model: Model | str | os.PathLike[str] | Callable[..., Any],
        *,
        parameters: Mapping[str, Any] | None = None,
        output: str | None = None,
        settings: Settings | None = None,
        progress: bool = True,
        **keywords: Any,
    ) -> None:
        chosen = changed(settings or Settings(), keywords)
        if isinstance(model, str | os.PathLike):
            model = load_model(os.fspath(model))
        self._work: CampaignWork | FunctionWork
        if isinstance(model, Model):
            if parameters is not None or output is not None:
                key = "parameters" if parameters is not None else "output"
                raise InputError(
                    "a model has its own", key=key, value=parameters if output is None else output,
                    hint="change the model: model.with_parameters(…)",
                )  # fmt: skip
            self._work = _of_campaign(data, model, chosen, progress)
        elif callable(model):
            self._work = _of_function(data, model, parameters, output, chosen, keywords)
        else:
            raise InputError(
                "is neither a model nor a function", key="model", value=model,
                hint='write bo.system("f16n2d2"), bo.load_model("model.py") or a function',
            )  # fmt: skip

    @property
    def settings(self) -> Settings:
        """Settings of all later steps."""
        return self._work.settings

    def check(self) -> Check:
        """Summarise the problem, compare the start with the data, and list warnings.

        Examples
        --------
        >>> problem.check().data_warnings  # doctest: +SKIP
        """
        return Check(self._work.check())

    @kept
    def fit(self, method: str = "MBE", *, progress: bool = True) -> Fit:
        """Estimate the parameters.

        Parameters
        ----------
        method : str
            Estimator, as in :func:`bayesoleo.estimation.estimate`, for example ``"MBE"`` or
            ``"levenberg-marquardt"``. The posterior's mode is reached from its estimate.
        progress : bool
            Whether to show what is being done, if it takes more than two seconds.

        Returns
        -------
        Fit

        Examples
        --------
        >>> fit = problem.fit(method="MBE")  # doctest: +SKIP
        """
        with status_line(progress) as callback:
            found, tree = self._work.fit(str(method).lower(), callback)
        return Fit(tree, self._work, found)

    def _text(self) -> str:
        return self._work.text()


def _of_campaign(data: Any, model: Model, settings: Settings, progress: bool) -> CampaignWork:
    if isinstance(data, Campaign):
        data = data.reduced
    if not isinstance(data, str | os.PathLike | measured.CampaignData | ReducedCampaign):
        raise InputError(
            "a model is fitted to a campaign", key="data", value=type(data).__name__,
            hint='write bo.load_campaign("folder")',
        )  # fmt: skip
    return CampaignWork(prepare(data, model, settings, progress=DELAY if progress else False))


#: Settings that only a campaign has.
_OF_CAMPAIGNS = ("drive", "nuisance", "disturbances", "between_runs", "scheme", "steps")


def _of_function(
    data: Any,
    function: Callable[..., Any],
    parameters: Mapping[str, Any] | None,
    output: str | None,
    settings: Settings,
    keywords: Mapping[str, Any],
) -> FunctionWork:
    for name in _OF_CAMPAIGNS:
        if name in keywords:
            raise InputError(
                "a function has no such setting", key=name, value=keywords[name],
                hint="leave it out",
            )  # fmt: skip
    if isinstance(data, str | os.PathLike | measured.CampaignData | ReducedCampaign):
        raise InputError(
            "a function is fitted to a table", key="data", value=type(data).__name__,
            hint='write {"x": x, "y": y} or a pandas table',
        )  # fmt: skip
    table = read_table(data)
    declared = parameters_of(parameters)
    measured_column = output_of(table, output, [*arguments_of(function), *declared])
    inputs = [name for name in table if name != measured_column]
    call = call_of(function, inputs, declared)
    name = getattr(function, "__name__", type(function).__name__)
    work = FunctionWork(name, call, table, measured_column, declared, settings)
    check_call(call, work.inputs, work.statement)
    return work
