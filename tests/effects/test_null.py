"""At the null an extended model is the old one, and what it adds is not singular."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

from bayesoleo.effects import Candidate
from bayesoleo.model import Model
from bayesoleo.model._expressions import derivative_symbol, partial, split_derivative, symbol

STATES = 3


def at_null(candidate: Candidate, old: Model, expression: sp.Expr) -> sp.Expr:
    """Amplitudes at their null, added dofs at their response to it: the static guess."""
    table = {}
    for dof in set(candidate.model.dofs) - set(old.dofs):
        response = sp.sympify(candidate.model.dofs[dof].guess)
        for order in range(3):
            table[derivative_symbol(dof, order)] = response if order == 0 else sp.Integer(0)
        for name in old.inputs:
            if response == symbol(name):
                for order in range(3):
                    table[derivative_symbol(dof, order)] = derivative_symbol(name, order)
    for name in candidate.parameters:
        table[symbol(name)] = sp.Float(candidate.model.parameters[name].value)
    return expression.xreplace(table)


def random_state(expressions: list[sp.Expr], model: Model, rng: np.random.Generator) -> dict:
    """Nominal parameters, and states near the middle of the motion."""
    state = dict(model.nominal())
    for item in sorted(set().union(*(e.free_symbols for e in expressions)), key=str):
        if item not in state:
            name, order = split_derivative(item)
            centre = 300.0 if name.startswith("temperature") and order == 0 else 0.1
            state[item] = centre * rng.uniform(0.5, 1.2) * (rng.choice([-1, 1]) if order else 1)
    return state


def value(expression: sp.Expr, state: dict) -> float:
    return float(sp.lambdify([], expression.xreplace({k: sp.Float(v) for k, v in state.items()}))())


@pytest.mark.slow
def test_extended_model_at_null_is_the_old_one(model, offered):
    rng = np.random.default_rng(1)
    found = offered(model)
    assert found
    for candidate in found:
        pairs = [(model.output(c), candidate.model.output(c)) for c in model.outputs]
        pairs += [(model.equation(d), candidate.model.equation(d)) for d in model.dofs]
        for before, after in pairs:
            reduced = at_null(candidate, model, after)
            if reduced == before:
                continue
            for _ in range(STATES):
                state = random_state([before, reduced], candidate.model, rng)
                old, new = value(before, state), value(reduced, state)
                # Rounding of terms that cancel: they are up to 1e7 in size.
                assert new == pytest.approx(old, rel=1e-9, abs=1e-6), candidate.effect


@pytest.mark.slow
def test_added_equations_determine_the_added_dofs_at_null(model, offered):
    rng = np.random.default_rng(2)
    for candidate in offered(model):
        for dof in set(candidate.model.dofs) - set(model.dofs):
            null = {symbol(name): sp.Float(0.0) for name in candidate.parameters}
            slope = partial(candidate.model.equation(dof), symbol(dof)).xreplace(null)
            slopes = [
                value(slope, random_state([slope], candidate.model, rng)) for _ in range(STATES)
            ]
            assert np.any(np.abs(slopes) > 1e-9), (candidate.effect, dof)


@pytest.mark.slow
def test_amplitudes_move_something(model, offered):
    """No amplitude is left out of the extended model."""
    for candidate in offered(model):
        expressions = [candidate.model.output(c) for c in candidate.model.outputs]
        expressions += [candidate.model.equation(d) for d in candidate.model.dofs]
        free = set().union(*(e.free_symbols for e in expressions))
        new = {symbol(name) for name in (*candidate.parameters, *candidate.shapes)}
        assert new <= free, candidate.effect


def test_candidates_respect_their_contract(model, offered):
    for candidate in offered(model):
        added = set(candidate.model.parameters) - set(model.parameters)
        assert added >= {*candidate.parameters, *candidate.shapes}
        assert set(candidate.sign) == set(candidate.parameters)
        assert set(candidate.sign.values()) <= {-1, 0, 1}
        for name in (*candidate.parameters, *candidate.shapes):
            assert not candidate.model.parameters[name].fixed
        for grid in candidate.shapes.values():
            ratios = np.divide(grid[1:], grid[:-1])
            assert np.all(ratios > 1)
            assert np.all(ratios <= 2 + 1e-9)
