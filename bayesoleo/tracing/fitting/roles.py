"""Which runs are fitted and which are held out, and what is done where none is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bayesoleo.errors import CampaignError
from bayesoleo.prediction.records import Record

#: Half a record needs two periods for an average of its own.
FEWEST_PERIODS_TO_SPLIT = 4
#: What is added to the label of half a run.
FIRST_HALF, SECOND_HALF = "first half", "second half"


@dataclass(frozen=True)
class RecordNoise:
    """The noise of one output in one run, as the models of a search have shown it so far.

    Parameters
    ----------
    sigma : float
        Of a sample, SI.
    input_noise : float
        Part of the averaged residual's noise that comes from the inputs, SI.
    """

    sigma: float
    input_noise: float


@dataclass(frozen=True)
class Roles:
    """Runs by role.

    Parameters
    ----------
    fitted, held_out : tuple of Record
        In leave-one-run-out both hold every run.
    strategy : {"declared", "leave-one-run-out", "split periods", "none"}
        How runs are held out.
    description : str
        The same as a sentence.
    measured : mapping of (run, output) to RecordNoise
        Noise is a property of the records: once it was measured no later model has more of it.
    """

    fitted: tuple[Record, ...]
    held_out: tuple[Record, ...]
    strategy: str
    description: str
    measured: Mapping[tuple[str, str], RecordNoise] = field(default_factory=dict)

    def noise_of(self, output: str, label: str) -> RecordNoise | None:
        """Of a run, or of the run that it is a half of; None where it was not measured yet.

        Where all that there is are two halves of one run, each has been measured by itself.
        """
        whole = label.removesuffix(f" ({FIRST_HALF})").removesuffix(f" ({SECOND_HALF})")
        return self.measured.get((label, output), self.measured.get((whole, output)))


def assign(records: Sequence[Record]) -> Roles:
    """Take the declared roles, or find another way to hold data out.

    Raises
    ------
    CampaignError
        If no run is to be fitted.
    """
    fitted = tuple(record for record in records if record.role == "fit")
    held_out = tuple(record for record in records if record.role != "fit")
    if not fitted:
        raise CampaignError(
            "no run has the role fit", hint='write role = "fit" in at least one run'
        )
    if held_out:
        return Roles(fitted, held_out, "declared", f"{len(held_out)} declared hold-out runs")
    if len(fitted) >= 2:
        text = (
            "no hold-out run is declared: every run is predicted by a fit to the others"
            " (leave-one-run-out)"
        )
        return Roles(fitted, fitted, "leave-one-run-out", text)
    (only,) = fitted
    if only.periods >= FEWEST_PERIODS_TO_SPLIT:
        first, second = halves(only)
        text = (
            "one run and no hold-out: fitted to the first half of its periods, held out the second"
        )
        return Roles((first,), (second,), "split periods", text)
    what = "one run of too few periods" if only.periodic else "one transient run"
    return Roles(fitted, (), "none", f"{what}: nothing could be held out")


def in_halves(roles: Roles) -> Roles | None:
    """The fitted runs' first halves to be fitted, and their second ones held out.

    Returns
    -------
    Roles or None
        None where a run has no halves that repeat, or runs are held out so or in turn already.
    """
    whole = all(r.periodic and r.periods >= FEWEST_PERIODS_TO_SPLIT for r in roles.fitted)
    if roles.strategy != "declared" or not whole:
        return None
    first, second = zip(*(halves(record) for record in roles.fitted), strict=True)
    text = "fitted to the first half of each run's periods, held out the second"
    return Roles(first, second, "split periods", text, roles.measured)


def halves(record: Record) -> tuple[Record, Record]:
    """The first and the second half of a periodic record's periods, as records of their own."""
    half = record.periods // 2
    middle = int(np.searchsorted(record.phase, half - 1e-9))
    if record.phase.size - middle + 1 < _samples(record, record.periods - half):
        # A record may be a sample short of whole periods; so may its first half instead.
        middle -= 1
    return (
        _part(record, slice(0, middle), half, FIRST_HALF, "fit"),
        _part(record, slice(middle, None), record.periods - half, SECOND_HALF, "hold-out"),
    )


def _samples(record: Record, periods: int) -> float:
    """Number of samples that so many periods take."""
    step = (record.time[-1] - record.time[0]) / (record.time.size - 1)
    return float(periods / (step * record.frequency))


def _part(record: Record, samples: slice, periods: int, name: str, role: str) -> Record:
    time = record.time[samples]
    shift = record.frequency * (time[0] - record.time[0])
    harmonics = {
        channel: replace(
            item, coefficients=item.coefficients * np.exp(2j * np.pi * item.orders * shift)
        )
        for channel, item in record.harmonics.items()
    }
    return replace(
        record,
        label=f"{record.label} ({name})",
        role=role,
        periods=periods,
        time=time,
        samples={channel: values[samples] for channel, values in record.samples.items()},
        kept=None if record.kept is None else record.kept[samples],
        harmonics=harmonics,
    )
