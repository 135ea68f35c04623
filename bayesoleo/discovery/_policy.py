"""The search policy: every number by which the search for missing effects decides.

Each field says what it decides, on what its value rests and how the outcome depends on it. The
table in ``docs/loop.md`` is made from the fields. Tolerances against round-off, and limits that
only bound the cost of computing, stay where they are used.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from bayesoleo import _distributions as distributions

CHOICE, NOT_MEASURED = "a choice", "not measured"


def _value[T](default: T, decides: str, basis: str = CHOICE, outcome: str = NOT_MEASURED) -> T:
    """A field with its documentation: what it decides, its basis, how the outcome depends on it."""
    found: T = field(
        default=default, metadata={"decides": decides, "basis": basis, "outcome": outcome}
    )
    return found


@dataclass(frozen=True)
class SearchPolicy:
    """The numbers by which a search decides; see the table in ``docs/loop.md``.

    Examples
    --------
    >>> SearchPolicy(significance=0.05).significance
    0.05
    """

    # -- estimates ----------------------------------------------------------------------
    mesh_shift: float = _value(
        0.1,
        "Largest shift of a parameter by halving the steps of the mesh, in posterior standard"
        " deviations; above it the mesh is refined or doubted.",
    )
    unseen: float = _value(
        1.0,
        "Change of the residual sum of squares of a long transient by finer steps, in variances of"
        " what a model leaves, that is accepted: the sum of the squared changes of the outputs plus"
        " the size of twice their product with the residual.",
        "twice the log likelihood of the present model changes by at most this. A candidate that"
        " reduces the sum of squares by `a` variances may have its reduction wrong by up to"
        " `2 sqrt(a) + 1` of them",
    )
    missed_factor: float = _value(
        3.0,
        "Factor by which the shift due to the error between steps must exceed the shift by halving"
        " them in order to replace it.",
        "both meshes then have the same error",
    )
    prior_draws: int = _value(
        256, "Vectors drawn from the priors when an estimate is repeated from other starts."
    )
    prior_starts: int = _value(4, "The most likely of these draws from which estimates start.")
    doubtful_prior: float = _value(
        1e-4,
        "Tail probability of an unknown under its prior below which its estimate is repeated from"
        " other starts.",
    )
    better_optimum: float = _value(
        3.0, "Rise of the log posterior by which an estimate from another start is preferred."
    )
    better_optimum_declared: float = _value(
        5.0,
        "The same where the error of the declared model exceeds the expected one.",
        "a smaller rise may come from an estimate that stopped early",
    )
    opposite_sign: float = _value(
        3.0,
        "Standard deviations from zero at which a parameter opposite in sign to its declared value"
        " is reported.",
    )

    # -- noise and expected errors ------------------------------------------------------
    noise_bands: int = _value(
        8, "Frequency bands, of equal power, in which the input's noise is bounded by the residual."
    )
    noise_false_alarm: float = _value(
        1e-3, "Probability that the true input noise is underestimated in any band."
    )
    clearly_less_noise: float = _value(
        0.9,
        "Ratio to the earlier noise of a transient's sample below which a later model lowers it.",
        "differences of neighbours determine the noise to a few per cent",
    )
    least_expected: float = _value(
        0.1,
        "Least expected error of a run, as a part of its noise.",
        "the part of the noise that estimates absorb is known by linearisation only",
    )
    curvature_draws: int = _value(
        64,
        "Draws of the unknowns that check the linearised error of a prediction.",
        "a mean square is then known to a fifth where one direction dominates",
    )
    curvature_matters: float = _value(
        1e-3,
        "Mean square of the linearised error, as a part of the residual's, above which it is"
        " checked.",
    )
    farthest_draw: float = _value(
        5.0,
        "Root mean squares at which the largest change by a draw is cut off.",
        "a resonance that grows without bound shows only that the posterior is not normal",
    )
    floor_ratio: float = _value(
        1.15, "Ratio to the expected error below which no effect is sought, however significant."
    )
    least_ratio: float = _value(
        0.75,
        "Ratio to the expected error below which the noise is wrong, unless chance explains it.",
        "the noise is then overestimated by a third",
    )
    floor_false_alarm: float = _value(
        1e-3,
        "Probability that noise and parameter errors alone exceed the limit of the ratio to the"
        " expected error.",
    )

    # -- scores -------------------------------------------------------------------------
    stretches: int = _value(
        8, "Stretches of a transient whose scatter replaces the scatter between periods."
    )
    excess_errors: float = _value(
        2.0,
        "Number of standard errors of the excess that is its least value in shares.",
        "noise alone exceeds it once in forty times; a part of a negligible excess is then no large"
        " share",
    )
    unsteady: float = _value(
        0.05, "Probability that stationary noise is taken for non-stationary noise."
    )
    aperiodic_power: float = _value(
        0.1,
        "Part of a direction's power between the harmonics above which it counts as non-repeating.",
        "leakage by incommensurate sampling is smaller",
    )
    same_cosine: float = _value(
        0.95,
        "Squared cosine above which two contributions are indistinguishable.",
        CHOICE,
        "in the stored study one of 235 certain names was wrong",
    )
    twin_cosine: float = _value(
        1.0 - 1e-6,
        "Squared cosine above which two effects of one family and place are equivalent.",
        "the remaining difference is the tolerance of a constant",
    )
    search_draws: int = _value(
        4000, "Draws of noise that give the effective number of independent tests."
    )

    # -- choice of an effect ------------------------------------------------------------
    significance: float = _value(
        0.01, "Corrected p-value below which an effect is significant: nominal false alarms."
    )
    floor_share: float = _value(
        0.10, "Share of the excess that the best effect must explain at the noise floor."
    )
    refits: int = _value(6, "Effects estimated before one is chosen.")
    near_best: float = _value(
        0.25, "Score, as a part of the best, above which an effect is estimated as well."
    )
    hidden_refits: int = _value(
        2,
        "Effects estimated that would be significant in white noise only.",
        "linearisation at the null is poor for some effects; only an estimate shows their size",
    )
    absorbing_refits: int = _value(3, "Effects of absorbing families that are estimated.")
    equal_share: float = _value(
        0.02, "Share of the excess within which effects are equal and the simplest is taken."
    )
    compared: int = _value(
        4, "Effects compared on hold-out runs where the first exceeds the expected error there."
    )
    compared_worth: float = _value(
        2.0,
        "Largest deficit of such an effect in Schwarz's criterion, in units of the difference"
        " between equally likely effects.",
    )
    equal_odds: float = _value(
        20.0, "Ratio of likelihoods below which two effects are equally likely."
    )
    both_wrong_errors: float = _value(
        2.0,
        "Standard errors of the difference of two models of transients that both leave more than"
        " noise, up to which they are about as likely.",
        "noise and the error that is left exceed it once in twenty times (Vuong 1989)",
    )
    equal_remainder: float = _value(
        1.25,
        "Ratio of remainders below which two similar effects that leave more than noise are"
        " indistinguishable.",
        "the likelihood of a wrong model overstates the evidence",
    )
    not_taken_odds: float = _value(
        2.0,
        "Largest advantage of an effect that was not added but stays in the class, in the same"
        " units.",
        "hold-out runs that do not confirm an effect do not exclude it",
    )
    prior_width: float = _value(
        10.0,
        "Standard deviation of a new amplitude's prior over its expected size.",
        "weak, but proper",
    )
    shape_spread: float = _value(
        1.0, "Log-normal spread of a shape parameter's prior about the scanned value."
    )

    # -- confirmation -------------------------------------------------------------------
    least_share: float = _value(0.05, "Smallest share of the excess that justifies another effect.")
    fair_share: float = _value(
        0.125,
        "The same for an effect that leaves more than noise.",
        "of four missing effects the strongest explains about a quarter; half of that is required",
        "smaller shares usually mean that a similar effect is the true one",
    )
    excluded_null: float = _value(
        0.975, "Posterior probability on the amplitude's own side of its null."
    )
    excluded_price: float = _value(
        2.0,
        "Fall of the sum of squares, in prices of the unknowns, that always excludes the null.",
        "far from the null the curvature understates the evidence (Hauck and Donner 1977)",
    )
    false_confirmation: float = _value(
        0.025,
        "Probability that an effect is confirmed although it does not lower the hold-out error.",
        CHOICE,
        "0.000 to 0.027 in six sets of 336 absent effects, runs periodic or not, noise white, slow"
        " or as fast as the motion",
    )
    trial_errors: float = _value(
        1.0,
        "Standard errors by which the hold-out error must fall for an effect in a transient to be"
        " added on trial.",
        "beside what several missing effects leave none is significant; each is judged in the final"
        " model",
    )
    missed_confirmation: float = _value(
        0.025,
        "Probability of missing a real effect above which hold-out runs cannot judge it alone.",
    )

    # -- elimination and review ---------------------------------------------------------
    plainly_needed: float = _value(
        200.0,
        "Wald statistic over the price of the unknowns above which an effect is kept untested.",
        "coloured noise does not explain such a factor",
        "saves fits; not measured beyond that",
    )
    review_rivals: int = _value(5, "Rivals of a final effect that are estimated in its place.")
    review_simpler: int = _value(
        3, "Rivals of a final effect that may make another effect superfluous."
    )
    review_confirmed: int = _value(3, "Better rivals that are tested on hold-out runs.")
    shape_starts: tuple[float, ...] = _value(
        (0.25, 0.5, 0.75),
        "Places in the scan of a shape from which an estimate is repeated.",
        "where friction switches, the error has several minima along the shape",
    )
    restart_share: float = _value(
        0.8, "Part of the best rival's fall above which an estimate is repeated."
    )
    restart_gap: float = _value(
        4.0, "Gap to the best rival, in squared standard deviations, above which it is repeated."
    )

    # -- other first effects ------------------------------------------------------------
    followed: int = _value(2, "Other first effects from which a full search starts.")
    followed_behind_clear: float = _value(
        0.02, "Largest relative deficit of their worth where causes led to the noise floor."
    )
    followed_behind: float = _value(
        0.1, "The same where absorbing effects or a curve did, or none did."
    )
    seconds: int = _value(4, "Second effects that are estimated beside another first effect.")

    # -- nonparametric effects ----------------------------------------------------------
    decisive: float = _value(
        10.0,
        "Advantage in Schwarz's criterion by which named effects must beat a curve.",
        "very strong evidence (Kass and Raftery 1995)",
    )
    curves: int = _value(1, "Curves added at most.")
    fewest_replaced: int = _value(
        2, "Named effects that a curve may replace where none may be added."
    )
    own_right: float = _value(
        0.9,
        "Share explained by the first effect alone above which no curve competes with it.",
        "the cubic spring of the Silverbox had given way to a spline in two coordinates",
    )
    finer_gain: float = _value(
        0.25, "Part of a curve's deficit that finer pieces must recover to be refined further."
    )
    finer: float = _value(0.01, "p-value below which finer pieces are significant.")
    curves_tried: int = _value(3, "Curves estimated before one is chosen.")
    pieces: tuple[int, ...] = _value(
        (2, 4, 8, 16, 32, 64),
        "Pieces of the range of one quantity.",
        "each number divides the next, so that all splines are sums of the finest",
    )
    pieces_of_two: tuple[int, ...] = _value((2, 4), "The same for each of two quantities.")
    paired: int = _value(1, "Best single quantities that are paired with every other.")
    own_direction: float = _value(
        0.03,
        "Part of a direction independent of the present parameters above which it belongs to a"
        " curve.",
    )
    resolved_spline: float = _value(
        0.03, "Effect of a spline on the outputs, over the strongest's, above which it is visible."
    )
    distinct_spline: float = _value(
        1e-4, "Relative eigenvalue above which a combination of splines is distinct."
    )
    equal_ranks: float = _value(
        0.9995,
        "Rank correlation above which two quantities are the same.",
        "smooth functions of either are then the same",
    )
    own_part: float = _value(
        0.1,
        "Part of a parameter's information left beside a curve below which the two are"
        " inseparable.",
        "its standard deviation would be three times as large",
    )
    beyond_curve: float = _value(
        0.01, "Part of a run's samples beyond a curve's range above which the run is reported."
    )

    # -- verdict and proposals ----------------------------------------------------------
    explained: float = _value(
        0.9,
        "Part of the excess that named physics must explain for the verdict *effect added*.",
        "the remaining error is then less than a third of the original",
    )
    proposal_rivals: int = _value(
        4, "Rivals compared when a run is proposed.", "each must be estimated"
    )
    separable: float = _value(
        1.0, "Standard deviations below which no run separates a pair of rivals."
    )
    enough_runs: int = _value(
        3,
        "Smallest number of runs whose scatter of a by-run parameter predicts its value in a new"
        " run.",
    )

    def changed(self) -> dict[str, Any]:
        """Fields that differ from their defaults, with their values."""
        pairs = ((item, getattr(self, item.name)) for item in fields(self))
        return {item.name: value for item, value in pairs if value != item.default}

    @property
    def equal_likelihood(self) -> float:
        """Twice the logarithm of :attr:`equal_odds`: the scale of a sum of squares."""
        return 2.0 * float(np.log(self.equal_odds))

    @property
    def confirming_errors(self) -> float:
        """Number of standard errors that a fall of the hold-out error must exceed."""
        return float(distributions.norm.isf(self.false_confirmation))


def _rows() -> Iterator[str]:
    for item in fields(SearchPolicy):
        about = item.metadata
        yield (
            f"| `{item.name}` | {item.default} | {about['decides']} | {about['basis']}"
            f" | {about['outcome']} |"
        )


def policy_table() -> str:
    """The fields as a Markdown table, as it stands in ``docs/loop.md``."""
    head = "| field | default | decides | rests on | the outcome depends on it |"
    return "\n".join([head, "|---|---|---|---|---|", *_rows()])
