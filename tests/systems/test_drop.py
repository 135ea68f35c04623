"""The oleo in a drop test against an independent integrator, and what rest demands."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bayesoleo.errors import InputError
from bayesoleo.model import driven_by
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Record
from bayesoleo.systems import system
from bayesoleo.systems._oleo import drop_test


def silent_record(model, time) -> Record:
    nothing = {name: np.zeros(time.size) for name in model.outputs}
    noise = dict.fromkeys(nothing, 0.0)
    return Record("drop", "", "fit", "transient", np.nan, np.nan, 0, time, nothing, {}, noise)


@pytest.mark.parametrize("mass", [350.0, 825.0])
def test_thermomechanical_drop_against_lsoda(mass):
    """Equations 6.3 and 6.4 written out by hand, at the nominal values of tables C.1 and D.1."""
    A, V, pa, p0, T0 = 3484e-6, 9.20e-4, 1e5, 4.9e5, 293.0
    s = 1.570e-8 * 8.314 / V
    heat = p0 * V * 743.0 / (296.8 * T0)

    def pressure(q, T):
        return p0 * (1 / T0 + s) * T / (1 - A * q / V + s * T)

    def reaction(q, v, T):
        p = pressure(q, T)
        friction = (65.0 + 2e-5 * p) * np.arctan(3400.0 * v)
        return 2897.0 * v * abs(v) + A * (p - pa) + friction

    def rates(t, z):
        q, v, T = z
        warming = A * (pressure(q, T) - pa) * v - 2.567 * (1 - A * q / V) * (T - T0)
        return [v, 9.81 - reaction(q, v, T) / mass, warming / heat]

    time = np.linspace(0.0, 2.0, 401)
    exact = solve_ivp(rates, (0, 2), [0, 0, T0], "LSODA", time, rtol=1e-10, atol=1e-12).y
    model = drop_test(system("f16n2d2"), mass)
    predictor = Predictor(model, [silent_record(model, time)], backend="numpy", jobs=1)
    theta = predictor.layout.start(model)
    assert predictor.set_anchor(theta)[0].ok
    y = dict(zip(predictor.outputs, predictor.simulate(theta[None], 0).y[0], strict=True))
    # the mesh is the integrator's own, chosen for 1e-6 of each dof's size
    np.testing.assert_allclose(y["displacement"], exact[0], atol=2e-5 * np.ptp(exact[0]))
    own = reaction(*exact)
    np.testing.assert_allclose(y["force"], own, atol=2e-3 * np.ptp(own))


def test_only_oleos_driven_by_force_are_dropped():
    with pytest.raises(InputError, match=r"duffing.*is no oleo.*f16n2d2"):
        drop_test(system("duffing"), 350.0)
    with pytest.raises(InputError, match="is no oleo driven by force"):
        drop_test(driven_by(system("f16n2d2"), "displacement"), 350.0)
    with pytest.raises(InputError, match="key mass: a drop needs a positive mass"):
        drop_test(system("f16n2d2"), 0.0)
