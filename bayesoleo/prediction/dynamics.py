"""A model under the inputs of one run, as integrators take it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesoleo.errors import ModelError
from bayesoleo.model import Model
from bayesoleo.model.kernels import kernels
from bayesoleo.model.switching import analytic_pieces
from bayesoleo.prediction.inputs import harmonics_of, highest_derivatives
from bayesoleo.prediction.records import Record
from bayesoleo.solvers.shooting.initial_value import Dynamics
from bayesoleo.solvers.shooting.signals import InputSignal, periodic_signal


def dynamics_of(
    model: Model, record: Record, active: Sequence[str] | None = None, backend: str = "numba"
) -> Dynamics:
    """The equations of a periodic run in analytic pieces, with its harmonics as inputs.

    Parameters
    ----------
    model : Model
        In the drive in which it is solved.
    record : Record
        A periodic run; its first sample is time zero.
    active : sequence of str, optional
        Parameters to differentiate by; by default those that are estimated.
    backend : {"numba", "numpy"}
        Of the kernels; NumPy's are called back from compiled code at every step, which is slow.

    Returns
    -------
    Dynamics
        Its constants ``p`` are the model's parameters and conditions in the model's order.

    Raises
    ------
    ModelError
        If there is nothing to integrate, or an output needs higher derivatives of a dof than the
        equations.
    """
    pieces = analytic_pieces(model)
    derived = kernels(pieces.model, active, backend).derived
    if not model.dofs:
        raise ModelError(f"model {model.name!r} has no dof", hint="evaluate its outputs instead")
    for dof, order in zip(derived.dofs, derived.orders, strict=True):
        if order != model.order(dof):
            raise ModelError(
                f"model {model.name!r}: an output needs a higher derivative of {dof!r} than its"
                " equation",
                hint="write the output in terms of what the equations contain, or use another "
                "solver than shooting: collocation or adaptive",
            )
    return Dynamics(
        kernels=kernels(pieces.model, active, backend),
        orders=derived.orders,
        signal=signal_of_rows(record, derived.inputs),
        active=len(derived.active),
        conditions=len(derived.admissible),
        switches=pieces.switches,
    )


def signal_of_rows(record: Record, rows: tuple[tuple[str, int], ...]) -> InputSignal:
    """Fourier coefficients of input rows; the time itself, which no equation has, is left zero."""
    used = {
        name: harmonics_of(record, name).for_derivative(highest)
        for name, highest in highest_derivatives(rows).items()
        if name != "time"
    }
    count = 1 + max((int(item.orders.max(initial=0)) for item in used.values()), default=0)
    table = np.zeros((len(rows), count), dtype=complex)
    for row, (name, derivative) in zip(table, rows, strict=True):
        if name == "time":
            continue
        item = used[name]
        rates = (2j * np.pi * record.frequency * item.orders) ** derivative
        row[item.orders] = np.where((item.orders == 0) & (derivative > 0), 0, rates)
        row[item.orders] *= item.coefficients
    return periodic_signal(record.frequency, table.real, -table.imag)
