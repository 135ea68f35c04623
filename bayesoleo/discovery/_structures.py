"""Structures: which effects act, alone or together, and whether there is something outside the
catalogue; their prior and their posterior probabilities.

The prior is stated: 0.45 that nothing is missing, 0.35 for effects of the catalogue, 0.2 for
something outside of it: no catalogue has every law. The share of the catalogue is divided equally
among families, then among the effects of a family, so that near copies do not weigh more. Within a
family the laws that textbooks begin with weigh more than their refinements.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from bayesoleo.discovery._assembly import Added
from bayesoleo.discovery._ranking import ABSORBING_FAMILIES

#: Prior weight of a family that absorbs any model error, beside that of one which names a cause.
ABSORBING = 0.2
#: The same of a family whose members multiply a declared term by any quantity, and name no law.
UNNAMED = 0.5
#: The laws that textbooks begin with, and their weight within a family. A power law, a Bouc-Wen
#: model or a contact law fits what each of these does as well, but is rarer.
COMMON = 3.0
COMMON_EFFECTS = frozenset(
    {
        "viscous_damping",
        "quadratic_damping",
        "direction_dependent_damping",
        "stroke_dependent_damping",
        "coulomb_friction",
        "dahl_friction",
        "linear_stiffness",
        "cubic_stiffness",
        "end_stop_lower",
        "end_stop_upper",
        "preload",
        "sensor_offset",
        "sensor_gain",
        "sensor_lag",
    }
)


#: Probability of a further effect where the numbers of a prior end, over that of the last number.
FURTHER = 0.25


@dataclass(frozen=True)
class StructurePrior:
    """Prior probabilities of structures.

    Parameters
    ----------
    nothing, catalogue, outside : float
        That nothing is missing, that effects of the catalogue are, and that only something outside
        of it is. They are divided by their sum.
    numbers : tuple of float
        Of one, two, three... effects, given that some act. Beyond the last, each further effect is
        a quarter as probable. They are divided by the sum of all.
    families : mapping of str to float
        Weights of families of effects. By default they are one, but less for parameters that vary
        from run to run and forces that repeat with the drive, because these absorb a part of
        whatever is missing and name no cause, and for terms that depend on any quantity.
    effects : mapping of str to float
        Weights of effects within their family, by id. By default they are three for the laws that
        textbooks begin with (:data:`COMMON_EFFECTS`), and one.
    """

    nothing: float = 0.45
    catalogue: float = 0.35
    outside: float = 0.2
    numbers: tuple[float, ...] = (0.75, 0.2, 0.04, 0.01)
    families: Mapping[str, float] = field(default_factory=dict)
    effects: Mapping[str, float] = field(default_factory=dict)

    @property
    def also_outside(self) -> float:
        """Probability that something outside acts too where effects of the catalogue do.

        A second thing is missing as often as a second effect of the catalogue is, and lies outside
        as often as the first.
        """
        more = 1.0 - self.share_of(1)
        return more * self.outside / (self.catalogue + self.outside)

    def share_of(self, count: int) -> float:
        """Probability of so many effects, given that some act."""
        beyond = count - len(self.numbers)
        own = self.numbers[-1] * FURTHER**beyond if beyond > 0 else self.numbers[count - 1]
        return own / (sum(self.numbers) + self.numbers[-1] * FURTHER / (1.0 - FURTHER))

    def weights(self, families: Mapping[Added, str]) -> dict[Added, float]:
        """Prior probability of each effect as the only one."""
        members: dict[str, dict[Added, float]] = {}
        for key, family in families.items():
            members.setdefault(family, {})[key] = self._within(key[0])
        usual = dict.fromkeys(ABSORBING_FAMILIES, ABSORBING) | {"dependence": UNNAMED}
        share = {name: self.families.get(name, usual.get(name, 1.0)) for name in members}
        total = sum(share.values())
        return {
            key: share[family] / total * own / sum(keys.values())
            for family, keys in members.items()
            for key, own in keys.items()
        }

    def _within(self, effect: str) -> float:
        """Weight of an effect within its family."""
        return self.effects.get(effect, COMMON if effect in COMMON_EFFECTS else 1.0)

    def resemblance(self, families: Mapping[Added, str]) -> dict[Added, float]:
        """Probability that a law outside the catalogue resembles each effect.

        Half of them look like parameters that vary from run to run or forces that repeat with the
        drive, which absorb a part of whatever is missing.
        """
        absorbing = {key for key, family in families.items() if family in ABSORBING_FAMILIES}
        weights = self.weights(families)
        found: dict[Added, float] = {}
        for some in (absorbing, families.keys() - absorbing):
            total = sum(weights[key] for key in some)
            share = 0.5 if 0 < len(absorbing) < len(families) else 1.0
            found |= {key: share * weights[key] / total for key in some if total > 0}
        return found

    def log_of_set(self, weights: Sequence[float]) -> float:
        """Logarithm of the probability of a set of effects, given that some act or are resembled,
        from those of its members; it comes about in any order."""
        share = self.share_of(len(weights)) * math.prod(weights) * math.factorial(len(weights))
        return math.log(share) if share > 0.0 else -math.inf

    def log_probability(
        self, effects: Sequence[Added], outside: bool, weights: Mapping[Added, float]
    ) -> float:
        """Logarithm of the prior probability of a structure."""
        total = self.nothing + self.catalogue + self.outside
        if not effects:
            share = (self.outside if outside else self.nothing) / total
            return math.log(share) if share > 0.0 else -math.inf
        rest = self.also_outside if outside else 1.0 - self.also_outside
        share = self.catalogue / total * rest
        if share <= 0.0:
            return -math.inf
        return math.log(share) + self.log_of_set([weights[key] for key in effects])


@dataclass(frozen=True)
class Structure:
    """A set of effects with its probability.

    Parameters
    ----------
    effects : tuple of (effect, target)
        Those that act; empty for none.
    outside : bool
        Whether something outside the catalogue acts.
    probability : float
    log_evidence : float
        Of the data, but for a constant that all structures share.
    estimated : bool
        Whether all its effects were estimated together; else it follows from scores.
    """

    effects: tuple[Added, ...]
    outside: bool
    probability: float
    log_evidence: float
    estimated: bool


@dataclass(frozen=True)
class AveragedParameter:
    """A parameter of the declared model, averaged over structures by their probabilities.

    Parameters
    ----------
    mean, sd : float or None
        SI. A structure that is improbable but far off may draw the mean out of the interval.
    low, high : float or None
        Ends of the central 90 % interval, SI.
    median : float or None
        SI; always within the interval.
    reason : str
        Why no figures are stated, all of them being None; empty where they are.
    """

    mean: float | None
    sd: float | None
    low: float | None
    high: float | None
    median: float | None
    reason: str = ""

    @classmethod
    def withheld(cls, reason: str) -> AveragedParameter:
        """Without figures."""
        return cls(None, None, None, None, None, reason)


def total_probability(structures: Iterable[Structure]) -> float:
    """Probability that one of these structures is true; rounding takes no sum above one."""
    return min(1.0, sum(s.probability for s in structures))


@dataclass(frozen=True)
class StructurePosterior:
    """Probabilities of all structures that were compared.

    Parameters
    ----------
    structures : tuple of Structure
        By falling probability; their sum is one.
    prior : StructurePrior
    parameters : mapping of str to AveragedParameter
        Parameters of the declared model, given any of the structures.
    """

    structures: tuple[Structure, ...]
    prior: StructurePrior
    parameters: Mapping[str, AveragedParameter] = field(default_factory=dict)

    @property
    def nothing(self) -> float:
        """Probability that nothing is missing."""
        return total_probability(s for s in self.structures if not s.effects and not s.outside)

    @property
    def outside(self) -> float:
        """Probability that something outside the catalogue acts, alone or beside effects."""
        return total_probability(s for s in self.structures if s.outside)

    @property
    def only_outside(self) -> float:
        """Probability that something outside the catalogue acts, and no effect of it."""
        return total_probability(s for s in self.structures if s.outside and not s.effects)

    @property
    def effects(self) -> dict[Added, float]:
        """Probability of each effect, by falling probability."""
        found: dict[Added, float] = {}
        for structure in self.structures:
            for key in structure.effects:
                found[key] = min(1.0, found.get(key, 0.0) + structure.probability)
        return dict(sorted(found.items(), key=lambda item: -item[1]))
