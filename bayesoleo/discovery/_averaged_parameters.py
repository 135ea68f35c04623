"""Parameters of the declared model, averaged over structures.

A structure's density of a parameter is that about its estimate where the data determine the
parameter well, and follows the model along the parameter elsewhere, in the structures that carry
most of the probability (:mod:`bayesoleo.discovery._parameter_section`). Where that is too dear, or
says nothing, nothing is stated.

References
----------
Hoeting, Madigan, Raftery and Volinsky (1999), *Statistical Science* 14(4), eq. 1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from bayesoleo._types import Array, Flags
from bayesoleo.discovery._adaptive_grid import GridDensity
from bayesoleo.discovery._assembly import Added
from bayesoleo.discovery._limited_parameters import ROUGH
from bayesoleo.discovery._parameter_mixture import TAIL, Mixture, part_of
from bayesoleo.discovery._parameter_section import Budget, Followed, Section
from bayesoleo.discovery._spectral_data import (
    EstimatedModel,
    LinearisedModel,
    SpectralData,
    linearised,
)
from bayesoleo.discovery._structure_comparison import Columns, Comparison
from bayesoleo.discovery._structure_parameters import Frame, GivenStructure, moments
from bayesoleo.discovery._structures import AveragedParameter, Structure

#: Structures less probable than this are left out.
LEAST = 0.005
#: Structures less probable than this part of all are not solved for, nor are more than the
#: heaviest; part of the probability in which a parameter is solved for at least.
WORTH, HEAVIEST, SOLVED = 0.1, 3, 0.5
#: Solutions of the model at most, for all parameters and structures: a part of those of a search.
MOST_SOLUTIONS = 150
#: Part of the probability in which a parameter may be determined poorly, and still be averaged.
UNANSWERED = 0.1
#: Part of a density where nothing could be solved, and bound of what its places miss, that are too
#: much to state an interval.
UNKNOWN, MISSED = 0.15, 0.3
#: Probabilities outside one end of an interval of 90 % that show it to be false.
LEAST_TAIL, MOST_TAIL = 0.02, 0.08
#: Part of the probability that is as good as all.
ALL = 0.995
#: Why no figures are stated: where, what is known there, and why no more.
WITHHELD = (
    "{where} {what}, and {why}: no average over structures is stated. A sampled posterior holds"
    " what the final model makes of it."
)
IN_ALL, IN_SOME = "In all structures", "In structures with a tenth of the probability or more"
BESIDE_OUTSIDE = "Where something outside the catalogue acts"
POORLY = "the data determine this parameter to worse than a tenth of itself"
BENT = "the density of this parameter is another than about its estimate"
RARE = "too many structures share the probability for the model to be followed in each"
BY_RUN = "it differs there from run to run, along which the model is not followed"
LONG = "solutions of so long a run take too much time to follow the model along it"
JOINT = "its prior depends on other parameters, so that the model is not followed along it alone"
UNSOLVED = "the model cannot be solved over enough of the range that it may have"
SPARSE = "the solutions of the model that may be spent on it do not suffice"
PEAKS = "its density has several peaks along the model"
EXCLUDED = (
    "Figures about the estimates lead to values of this parameter that its prior excludes: no"
    " average over structures is stated. A sampled posterior holds what the final model makes of"
    " it."
)
#: Fall of a prior's log density that excludes a value: six standard deviations of a normal prior.
EXCLUDING = 18.0


@dataclass(frozen=True)
class _Unknown:
    """What is not known of a parameter in one structure, and why."""

    probability: float
    outside: bool
    what: str
    why: str


def _reason(unknown: Sequence[_Unknown], total: float) -> str:
    """Why a parameter has no average, by what the structures with most of the probability lack."""
    lacking = sum(one.probability for one in unknown)
    outside = sum(one.probability for one in unknown if one.outside)
    where = IN_ALL if lacking > ALL * total else IN_SOME
    where = BESIDE_OUTSIDE if outside > ALL * lacking else where
    weight: dict[tuple[str, str], float] = {}
    for one in unknown:
        key = one.what, one.why
        weight[key] = weight.get(key, 0.0) + one.probability
    what, why = max(weight, key=lambda key: weight[key])
    return WITHHELD.format(where=where, what=what, why=why)


@dataclass
class _Known:
    """A structure with its densities about its anchor's estimate."""

    structure: Structure
    frame: Frame
    here: LinearisedModel
    about: GivenStructure
    power: Array
    mean: Array
    sd: Array
    mixtures: list[Mixture]
    poor: Flags

    @classmethod
    def of(
        cls, structure: Structure, anchor: EstimatedModel, comparison: Comparison, columns: Columns
    ) -> _Known:
        """About an anchor."""
        here = linearised(anchor, comparison.data)
        frame = Frame.of(structure, anchor, comparison, columns, here)
        about = frame.about(here)
        normals = about.normals()
        if not normals:
            none = np.zeros(len(here.names))
            return cls(structure, frame, here, about, none, none, none, [], none > 0)
        coordinates, (mean, sd) = about.bent(anchor.fit, normals), moments(normals)
        mixtures = about.mixtures(coordinates, normals, structure.probability)
        poor = about.poorly(mean, sd)
        poor &= np.array([_own(anchor, here, k) for k in range(len(here.names))])
        return cls(structure, frame, here, about, coordinates.power, mean, sd, mixtures, poor)

    @property
    def probability(self) -> float:
        """Of the structure."""
        return self.structure.probability

    def numbers(self, name: str) -> list[int]:
        """Numbers of a parameter of the declared model, or of what it is in each run."""
        own = [k for k, other in enumerate(self.about.names) if name == other]
        return own or [k for k, n in enumerate(self.about.names) if n.split("[")[0] == name]


def averaged(
    structures: Sequence[Structure],
    anchors: Mapping[tuple[frozenset[Added], bool], EstimatedModel],
    comparison: Comparison,
    columns: Columns,
    names: Sequence[str],
) -> dict[str, AveragedParameter]:
    """Mixtures over structures.

    Parameters
    ----------
    structures : sequence of Structure
    anchors : mapping of (effects, outside) to EstimatedModel
        The model about which each structure was compared.
    comparison : Comparison
    columns : Columns
        Of all candidates.
    names : sequence of str
        Parameters of the declared model. Where a structure lets one differ between runs, its value
        is that of each run with equal weight.
    """
    every = []
    for structure in structures:
        key = frozenset(structure.effects), structure.outside
        if structure.probability < LEAST or key not in anchors:
            continue
        known = _Known.of(structure, anchors[key], comparison, columns)
        every += [known] if known.mixtures else []
    solved = _Solved(comparison.data)
    exact = [_Exact(known, solved) for known in every]
    total = sum(known.probability for known in every)
    for one in exact[:HEAVIEST]:
        if one.known.probability >= WORTH * total:
            one.follow(names)
    found = {name: _average(name, exact, total) for name in names if every}
    return {name: one for name, one in found.items() if one is not None}


def _average(name: str, exact: Sequence[_Exact], total: float) -> AveragedParameter | None:
    """The mixture of all structures that have a parameter.

    A structure that was not solved for differs from what is known of it about its estimate as the
    most probable one does that was.
    """
    solved = [one for one in exact if one.solved(name)]
    enough = sum(one.known.probability for one in solved) >= SOLVED * total
    parts, unknown = list[Mixture](), list[_Unknown]()
    for one in exact:
        mixtures, lacking = one.of(name), one.unknown(name)
        if enough and not one.is_followed:
            mixtures = [solved[0].changed(name, mixture) for mixture in mixtures]
            lacking = None
        share = one.known.probability / max(len(mixtures), 1)
        parts += [mixture.scaled(share) for mixture in mixtures]
        unknown += [] if lacking is None else [lacking]
    if not parts:
        return None
    if sum(one.probability for one in unknown) > UNANSWERED * total:
        return AveragedParameter.withheld(_reason(unknown, total))
    found = Mixture.of(parts).summary()
    return AveragedParameter.withheld(EXCLUDED) if _is_excluded(name, exact, found) else found


def _is_excluded(name: str, exact: Sequence[_Exact], found: AveragedParameter) -> bool:
    """Whether an interval reaches to where a prior leaves nothing, although no estimate does.

    A structure's outputs are linear about the estimate of another one only so far.
    """
    assert found.low is not None
    assert found.high is not None
    every = [(one.known.here, k) for one in exact for k in one.known.numbers(name)]
    prior = every[0][0].priors[every[0][1]]
    places = np.array([*(here.theta[k] for here, k in every), found.low, found.high])
    low, high = prior.support
    with np.errstate(all="ignore"):
        falls = prior.log_density(prior.mean) - prior.log_density(places)
    falls = np.where((places > low) & (places < high), falls, np.inf)
    return bool(np.max(falls[-2:]) > EXCLUDING + max(float(np.max(falls[:-2])), 0.0))


@dataclass
class _Solved:
    """Solutions along parameters, by anchor, which structures share."""

    data: SpectralData
    sections: dict[tuple[int, str], Section] = field(default_factory=dict)
    budget: Budget = field(default_factory=lambda: Budget(MOST_SOLUTIONS))

    def section(self, known: _Known, name: str) -> Section:
        """Those along a parameter; what was solved along others is where they begin."""
        anchor = known.frame.anchor
        own = (id(anchor), name)
        if own not in self.sections:
            self.sections[own] = Section(
                anchor, self.data, name, known.here, known.power, self.budget
            )
        others = [one for key, one in self.sections.items() if key[0] == own[0] and key != own]
        self.sections[own].seeds = [place for one in others for place in one.places.values()]
        return self.sections[own]


class _Exact:
    """Densities in one structure; those that the data determine poorly follow the model."""

    def __init__(self, known: _Known, solved: _Solved) -> None:
        self.known, self.at = known, solved
        self.poor = known.poor.copy()
        self.is_followed = False
        self.followed: list[Followed] = []
        #: Values of equal probability of what is determined poorly.
        self.values: dict[int, Array] = {}
        #: Why others that are determined poorly have none.
        self.why: dict[int, str] = {}

    def of(self, name: str) -> list[Mixture]:
        """Densities of a parameter, or of what it is in each run."""
        own, mixtures = self.known.numbers(name), []
        for k in own:
            values = self.values.get(k)
            plain = self.known.mixtures[k]
            mixtures.append(
                plain if values is None else part_of(1.0 / values.size, values, 0, False)
            )
        return mixtures

    def unknown(self, name: str) -> _Unknown | None:
        """What is not known of a parameter; None where its densities are known."""
        own = self.known.numbers(name)
        lacking = [k for k in own if self.poor[k] and k not in self.values]
        if not lacking:
            return None
        k = lacking[0]
        structure, what = self.known.structure, POORLY if self.known.poor[k] else BENT
        why = self.why.get(k, BY_RUN if self.is_followed else RARE)
        return _Unknown(structure.probability, structure.outside, what, why)

    def solved(self, name: str) -> bool:
        """Whether a parameter's density here is not that about the estimate."""
        own = self.known.numbers(name)
        return len(own) == 1 and own[0] in self.values

    def changed(self, name: str, mixture: Mixture) -> Mixture:
        """A density about another structure's estimate, with the change that the one here had."""
        (k,) = self.known.numbers(name)
        return mixture.changed(self.known.mixtures[k], self.values[k])

    def follow(self, names: Sequence[str]) -> None:
        """Follow the model along each parameter that is determined poorly, the poorest first.

        Others that are determined well given its value are known by that. So are those of which it
        shows that their densities are others than about the estimate.
        """
        known, tried = self.known, set[int]()
        self.is_followed = True
        own = [known.about.names.index(name) for name in names if name in known.about.names]
        own = [k for k in own if _own(known.frame.anchor, known.here, k)]
        coordinates = known.about.coordinates
        width = known.sd / np.where(coordinates.logarithmic, 1.0, coordinates.spread)
        own = sorted(own, key=lambda k: -width[k])
        while new := [k for k in own if self.poor[k] and k not in tried]:
            for k in new:
                tried.add(k)
                found = self._beside(k)
                found = self._along(k) if found is None else found
                if found is not None:
                    self.values[k] = coordinates.parameter(k, found)
            for k in own:
                self.poor[k] |= any(self._differs(k, one) for one in self.followed)

    def _beside(self, k: int) -> Array | None:
        """Coordinates of a parameter that is determined well given another one along which the
        model was followed; of several, by that which leaves most of it open."""
        coordinates = self.known.about.coordinates
        limit = ROUGH * (1.0 if coordinates.logarithmic[k] else coordinates.spread[k])
        able = [one for one in self.followed if np.sqrt(np.mean(one.sd[:, k] ** 2)) < limit]
        if not able:
            return None
        widest = max(able, key=lambda one: one.moments(k)[1])
        with np.errstate(divide="ignore"):
            ends = coordinates.coordinate(k, np.array(coordinates.priors[k].support))
        return np.clip(widest.values(k), *ends)

    def _along(self, k: int) -> Array | None:
        """Coordinates of a parameter along which the model is followed; None where that is too
        dear, or says nothing."""
        known, section = self.known, self.at.section(self.known, self.known.about.names[k])
        if not section.able:
            self.why[k] = LONG if section.is_long else JOINT
            return None
        found = section.density(known.frame, known.about, *self._moments(k))
        lacking = _lacking(None if found is None else found.grid, section.is_spent)
        if found is None or lacking:
            self.why[k] = lacking
            return None
        self.followed.append(found)
        return found.grid.values

    def _moments(self, k: int) -> tuple[float, float]:
        """Mean and deviation of a coordinate, as far as they are known: the widest."""
        every = [one.moments(k) for one in self.followed]
        every.append((float(self.known.mean[k]), float(self.known.sd[k])))
        return max(every, key=lambda item: item[1])

    def _differs(self, k: int, one: Followed) -> bool:
        """Whether tails of an interval about the estimate hold another part than they should."""
        if self.poor[k]:
            return True
        mixture, coordinates = self.known.mixtures[k], self.known.about.coordinates
        ends = np.array([mixture.quantile(chance) for chance in (TAIL, 1.0 - TAIL)])
        low, high = coordinates.coordinate(k, ends)
        tails = one.below(k, low), 1.0 - one.below(k, high)
        return min(tails) < LEAST_TAIL or max(tails) > MOST_TAIL


def _own(anchor: EstimatedModel, here: LinearisedModel, k: int) -> bool:
    """Whether a parameter is one of the system: not known by a measurement of its own, and no
    offset of one run, in which outputs are as good as linear."""
    name = here.names[k]
    offset = "[" in name and here.priors[k].support[0] < 0.0
    return name not in anchor.fit.problem.nuisances and not offset


def _lacking(found: GridDensity | None, spent: bool) -> str:
    """Why a density is not known well enough to be stated; empty where it is.

    Parameters
    ----------
    found : GridDensity or None
    spent : bool
        Whether no more solutions were allowed: those that are missing say nothing of the model.
    """
    if found is None or found.unknown >= UNKNOWN:
        return SPARSE if spent else UNSOLVED
    if found.gap >= MISSED:
        return SPARSE
    return PEAKS if found.modes != 1 else ""
