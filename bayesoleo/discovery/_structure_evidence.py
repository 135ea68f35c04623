r"""Marginal likelihoods of structures, linearised about an estimate.

A structure is a set of effects that act, with or without something outside the catalogue. About an
estimate the residual of all runs is

.. math:: e = J \delta + \sum_{k \in S} C_k b_k + \sum_k c_k \beta_k + g + \varepsilon

with the sensitivities :math:`J` of the present unknowns, whose priors are those of the model; the
changes :math:`C_k` of the outputs by each effect that acts, scaled to unit root mean square in
units of the noise; and what lies outside the catalogue: a law that resembles many effects a
little, :math:`\beta_k \sim N(0, a^2 w_k)`, and a smooth function of phase :math:`g` of each run.
The amplitude of an effect that acts has a moment density,
:math:`p(b_k) \propto b_k^2 N(b_k; 0, \tau^2/3)` with root mean square :math:`\tau`: it vanishes at
zero, for an effect of no size is none. Under a normal density most of what is called missing could
not be seen in the data, and nothing could ever be said to be missing for sure. Sizes :math:`\tau`,
:math:`a` and that of :math:`g` are integrated over a grid, with equal weight by decade from the
smallest change that could be seen to the size of the signal itself. The size of an effect is that
of the part of its change that the unknowns cannot make. The measured noise is itself uncertain,
which makes the density Student's; sizes are in units of the noise as the data have it.

References
----------
Kennedy and O'Hagan (2001), *J. R. Statist. Soc.* B 63, section 4; Kass and Raftery (1995), *JASA*
90, 773-795, for marginal likelihoods; Johnson and Rossell (2010), *J. R. Statist. Soc.* B 72,
143-170, eqs. 4 and 11, for moment densities.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayesoleo._types import Array, Integers
from bayesoleo.discovery._structure_columns import Group, Likelihood, Reduced, moment_power
from bayesoleo.discovery._structure_moments import beside, pairs, singles


@dataclass(frozen=True)
class Largest:
    """Largest log evidence so far of each of some effects, without and with something outside.

    What is far below it counts for nothing and need not be exact.

    Parameters
    ----------
    value : ndarray, shape (2, effects)
    """

    value: Array

    @classmethod
    def of(cls, effects: int) -> Largest:
        """Nothing so far."""
        return cls(np.full((2, effects), -np.inf))


def effect_evidence(
    parts: Reduced,
    likelihood: Likelihood,
    groups: Sequence[Group],
    sizes: Array,
    labels: Sequence[int] | None = None,
    largest: Largest | None = None,
) -> Array:
    """Log evidence of one effect at each size, shape (P, groups, sizes).

    Parameters
    ----------
    parts : Reduced
    likelihood : Likelihood
    groups : sequence of Group
        Effects, each as the only one.
    sizes : ndarray, shape (T,)
        ``tau``, in units of the columns.
    labels : sequence of int, optional
        Effect of each group; by default each is one.
    largest : Largest, optional
        Of these effects, of calls before and this one.
    """
    of = np.arange(len(groups)) if labels is None else np.asarray(labels)
    best = (largest or Largest.of(int(of.max(initial=-1)) + 1)).value
    found = np.empty((len(parts.square), len(groups), sizes.size))
    single = np.array([k for k, g in enumerate(groups) if len(g.columns) == 1], dtype=int)
    if single.size:
        some = [groups[k] for k in single]
        found[:, single] = _singly(parts, likelihood, some, sizes, of[single], best)
    for k, group in enumerate(groups):
        if len(group.columns) > 1:
            found[:, k] = _together(parts, likelihood, group, sizes, int(of[k]), best)
    return found


def _beside(parts: Reduced, columns: Integers) -> tuple[list[int], Array, Array, Array]:
    """An anchor's amplitudes with the parts first, as compiled loops take them: how many each of
    its effects has, means (P, m), covariance (P, m, m), and what they lose by columns (P, ..., m).
    """
    own = parts.own
    if own is None:
        number = len(parts.square)
        return (
            [],
            np.empty((number, 0)),
            np.empty((number, 0, 0)),
            np.empty((number, *columns.shape, 0)),
        )
    gain = np.moveaxis(own.gain[:, :, columns], 0, -1)
    return (
        own.counts,
        np.ascontiguousarray(own.mean.T),
        np.ascontiguousarray(np.moveaxis(own.covariance, 2, 0)),
        np.ascontiguousarray(gain),
    )


def _singly(
    parts: Reduced,
    likelihood: Likelihood,
    groups: Sequence[Group],
    sizes: Array,
    labels: Integers,
    best: Array,
) -> Array:
    """Log evidence of effects with one amplitude each, shape (P, groups, sizes)."""
    index = np.array([group.columns[0] for group in groups], dtype=int)
    counts, mean, covariance, gain = _beside(parts, index)
    before = [] if parts.own is None else parts.own.positive
    found = np.empty((len(parts.square), index.size, sizes.size))
    singles(
        np.array([*counts, 1], dtype=np.int64),
        np.array([[*before, group.positive] for group in groups]),
        mean,
        covariance,
        gain[..., None],
        np.ascontiguousarray(parts.slope[:, index]),
        np.ascontiguousarray(parts.products(index, index)),
        parts.square,
        parts.log_det,
        moment_power(sizes, 1),
        likelihood.count,
        float(likelihood.freedom),
        labels,
        best,
        found,
    )
    return found


def _together(
    parts: Reduced, likelihood: Likelihood, group: Group, sizes: Array, label: int, best: Array
) -> Array:
    """Log evidence of an effect with several amplitudes, shape (P, sizes)."""
    index = np.array(group.columns)
    values, vectors = np.linalg.eigh(parts.products(index[:, None], index))
    turned = (np.swapaxes(vectors, 1, 2) @ parts.slope[:, index, None])[:, None, :, 0]
    power = moment_power(sizes, index.size)[:, None]
    spread = power / (1.0 + power * np.maximum(values, 0.0)[:, None])  # (P, sizes, amplitudes)
    gain = np.sum(spread * turned**2, axis=2)
    logs = parts.log_det[:, None] - np.log(spread / power).sum(axis=2)
    square = parts.square[:, None] - gain
    value, noise = likelihood(square, logs) - np.log(power[:, 0]), likelihood.noise(square)
    if parts.own is None:
        # Turned amplitudes are independent; the mean of their squares is that of the others.
        squares = (spread * turned) ** 2 / noise[:, :, None] + spread
        return np.asarray(value + np.log(np.mean(squares, axis=2)))
    counts, own, covariance, lost = _beside(parts, index)
    found = np.empty(value.shape)
    beside(
        np.array([*counts, index.size], dtype=np.int64),
        np.array([*parts.own.positive, group.positive]),
        own,
        covariance,
        np.ascontiguousarray(np.swapaxes(lost, 1, 2)),
        np.einsum("pab,ptb->pta", vectors, spread * turned),
        np.einsum("pab,ptb,pcb->ptac", vectors, spread, vectors),
        noise,
        value,
        label,
        best,
        found,
    )
    return found


def pair_evidence(
    parts: Reduced,
    likelihood: Likelihood,
    one: Group,
    others: Sequence[Group],
    sizes: Array,
    labels: Sequence[int] | None = None,
    largest: Largest | None = None,
) -> Array:
    """Log evidence of an effect together with each of others, of one amplitude each.

    Labels are those of the others, as of :func:`effect_evidence`.

    Returns
    -------
    ndarray, shape (P, others, sizes, sizes)
    """
    (i,), index = one.columns, np.array([group.columns[0] for group in others], dtype=int)
    of = np.arange(index.size) if labels is None else np.asarray(labels)
    found = np.empty((len(parts.square), index.size, sizes.size, sizes.size))
    pairs(
        np.array([[one.positive, group.positive] for group in others]),
        np.ascontiguousarray(parts.slope[:, i]),
        np.ascontiguousarray(parts.products(np.array(i), np.array(i))),
        np.ascontiguousarray(parts.slope[:, index]),
        np.ascontiguousarray(parts.products(index, index)),
        np.ascontiguousarray(parts.products(np.array(i), index)),
        parts.square,
        parts.log_det,
        moment_power(sizes, 1),
        likelihood.count,
        float(likelihood.freedom),
        of,
        (largest or Largest.of(int(of.max(initial=-1)) + 1)).value,
        found,
    )
    return found


def compile_evidence() -> None:
    """Compile what a comparison of structures needs, which takes ten seconds, or load it.

    An anchor and two effects, one of two amplitudes, in a small problem without unknowns.
    """
    part = Reduced.of(np.eye(6)[None], np.zeros(1), 0, np.zeros(0))
    likelihood, sizes = Likelihood(9, 9.0), np.ones(1)
    effect_evidence(part, likelihood, [Group((0,))], sizes)
    pair_evidence(part, likelihood, Group((0,)), [Group((1,))], sizes)
    anchored = part.with_effects([Group((0,))], [1.0])
    effect_evidence(anchored, likelihood, [Group((0,)), Group((1, 2))], sizes)
    anchored.log_moment(likelihood)
