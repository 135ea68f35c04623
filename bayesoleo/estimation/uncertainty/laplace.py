"""Gaussian approximation of the joint posterior of parameters and log variances at a mode."""

from __future__ import annotations

import numpy as np

from bayesoleo._types import Array
from bayesoleo.error_models.independent import output_counts, staged_variance, sums_of_squares
from bayesoleo.error_models.linearise import LinearisedResidual, inverse_gram
from bayesoleo.estimation.problems.problem import Problem
from bayesoleo.estimation.problems.scaling import PriorScale


def mode_covariance(problem: Problem, theta: Array) -> Array:
    """Covariance of ``(theta, log v)`` by linearisation at a mode of ``Phi_B``.

    The blocks of the inverse are ``A + diag(w)^-1`` for the parameters, ``n_b / 2`` for the log
    variances and ``-sum(e_theta e) / v_b`` between them; these last vanish at the
    maximum-likelihood point of one output, not at a mode.

    Parameters
    ----------
    problem : Problem
    theta : ndarray, shape (l,)
        A mode, from :func:`~bayesoleo.estimation.polish`.

    Returns
    -------
    ndarray, shape (l + s, l + s)
        In the units of the parameters and without unit for the log variances; NaN where the
        problem cannot be evaluated. Where the cross terms make the inverse indefinite, as happens
        away from a mode, they are left out.

    References
    ----------
    Verbeek (1993), Appendix A, in ``log v`` and with Gauss-Newton's second derivatives.
    """
    theta = np.array(theta, dtype=float)
    unknowns, outputs = theta.size, len(problem.outputs)
    evaluation = problem.evaluate(theta)
    if not evaluation.status.ok:
        return np.full((unknowns + outputs, unknowns + outputs), np.nan)
    scale = PriorScale.of(problem.priors, problem.names)
    counts = output_counts(problem.counts)
    variance = staged_variance(sums_of_squares(evaluation), counts)
    chain = scale.unit(theta)
    rows = LinearisedResidual.of(evaluation, chain).whitened(variance)[0]
    covariance = inverse_gram(np.vstack((rows, scale.root)))
    cross = np.column_stack(
        [
            chain * (sensitivity.T @ residual) / v
            for sensitivity, residual, v in zip(
                evaluation.sensitivity, evaluation.residual, variance, strict=True
            )
        ]
    )
    joint = _block_inverse(covariance, cross, counts / 2)
    unit = np.concatenate((chain, np.ones(outputs)))
    return joint * np.outer(unit, unit)


def _block_inverse(covariance: Array, cross: Array, diagonal: Array) -> Array:
    """Inverse of ``[[covariance^-1, cross], [cross', diag(diagonal)]]`` by its Schur complement."""
    schur = np.diag(diagonal) - cross.T @ covariance @ cross
    if np.linalg.eigvalsh(schur)[0] <= 0:
        schur, cross = np.diag(diagonal), np.zeros_like(cross)
    lower = np.linalg.inv(schur)
    gain = covariance @ cross
    upper = covariance + gain @ lower @ gain.T
    return np.block([[upper, -gain @ lower], [-lower @ gain.T, lower]])
