"""Probabilities of structures under the prior by which the study draws them.

The default prior gives each of some sixty effects its share, the study draws sixteen effects in
their places. Where its own prior is used, statements are right as often as they say if marginal
likelihoods are right: the rest of a difference between what is said and what is true is the
prior's.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import logsumexp

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "benchmarks"))
import truth_effects as truth
from structure_figures import OUTSIDE

NOTHING = "nothing"
#: Of campaigns: those that lack nothing, one effect, two effects, something outside.
SHARES = {NOTHING: 0.25, "one": 0.375, "two": 0.125, OUTSIDE: 0.25}
#: Kinds of system, and those of them with a law outside the catalogue.
KINDS, STRANGE_KINDS = 6, 5
#: Damping in one direction of motion is damping by direction beside that which the model has.
BY_DIRECTION = {
    "compression_damping": "direction_dependent_damping",
    "extension_damping": "direction_dependent_damping",
}

#: Effects that act together; or that nothing, or something outside, does.
Acting = frozenset[str]


def _named(effect: str, target: str) -> str:
    return f"{BY_DIRECTION.get(effect, effect)} @ {target}"


@cache
def mix(kind: str) -> dict[Acting, float]:
    """How often a campaign of a kind of system lacks what, but for a constant."""
    found = {frozenset({NOTHING}): SHARES[NOTHING] / KINDS}
    if kind != "thermal":
        found[frozenset({OUTSIDE})] = SHARES[OUTSIDE] / STRANGE_KINDS
    for share, cases in (("one", truth.singles()), ("two", truth.pairs())):
        for case in cases:
            if case.kind == kind:
                acting = frozenset(_named(item.effect, item.target) for item in case.missing)
                found[acting] = found.get(acting, 0.0) + SHARES[share] / len(cases)
    return found


def statements_by_mix(row: Mapping[str, Any]) -> list[tuple[float, bool]]:
    """Probabilities under the study's prior from the evidence of a row, and whether what they are
    of is true."""
    ways: dict[Acting, list[float]] = {}
    for effects, outside, log in row["evidence"]:
        if outside and effects:
            continue  # the study does not draw both
        acting = frozenset(_named(*effect) for effect in effects)
        if len(acting) < len(effects):
            continue  # one effect under two names
        acting = acting or frozenset({OUTSIDE if outside else NOTHING})
        ways.setdefault(acting, []).append(log)
    # Names of one effect are ways to one evidence.
    logs = {acting: float(logsumexp(each) - np.log(len(each))) for acting, each in ways.items()}
    prior = {acting: share for acting, share in mix(row["kind"]).items() if acting in logs}
    if not prior:
        return []
    height = np.array([np.log(share) + logs[acting] for acting, share in prior.items()])
    said: dict[str, float] = {}
    for acting, p in zip(prior, np.exp(height - logsumexp(height)), strict=True):
        for name in acting:
            said[name] = said.get(name, 0.0) + float(p)
    true = {_named(*name.split(" @ ")) for name in row["truth"]}
    true |= {row["what"]} & {NOTHING, OUTSIDE}
    return [(p, name in true) for name, p in said.items()]
