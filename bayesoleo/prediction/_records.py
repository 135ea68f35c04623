"""Reduced records: the form in which a run reaches the models, made from a campaign or from arrays.

A channel has two parts. Its raw samples are compared with a prediction by the likelihood. Its
signal is an input of a model, together with its time derivatives: the significant harmonics of a
periodic channel, the band-limited curve through a transient one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol, cast

import numpy as np

from bayesoleo._types import Array, Bool, Complex, ComplexArray, Flags, Float, Int, Integers
from bayesoleo.errors import CampaignError
from bayesoleo.prediction._band_limited import Smoothed, band_limited_channels, sample_noise

PERIODIC, TRANSIENT = "periodic", "transient"
#: Harmonic orders of one table of exponentials: those of hundreds are products of two tables.
TABLE = 32
#: A smoother needs that many samples.
FEWEST_SAMPLES = 8


class Signal(Protocol):
    """An input as a model takes it: values and derivatives at any phase of a run."""

    def evaluate(
        self, phase: Float[Array, " samples"], frequency: float, derivative: int = 0
    ) -> Float[Array, " samples"]:
        """Value or time derivative at phases, shape (N,); see :class:`Harmonics`."""

    def for_derivative(self, highest: int) -> Signal:
        """The signal for a model that takes derivatives of it up to an order."""


@dataclass(frozen=True)
class Harmonics:
    """A periodic signal ``x(t) = Re sum_k c_k exp(2 pi i k f (t - origin))``.

    Parameters
    ----------
    orders : ndarray of int, shape (K,)
        Harmonic orders, ascending; 0 is the mean.
    coefficients : ndarray of complex, shape (K,)
        Complex amplitudes, in the channel's SI unit; that of order 0 is real.
    variances : ndarray of float, shape (K,)
        Variance of the real part of each coefficient, equal to that of its imaginary part.
    limits : tuple of float
        Orders up to which the value counts as an input, and those up to which derivatives of rising
        order may be taken: beyond, what repeats is rounding or noise of the sensor. The last holds
        for all further ones; none where all harmonics count.
    """

    orders: Int[Integers, " harmonics"]
    coefficients: Complex[ComplexArray, " harmonics"]
    variances: Float[Array, " harmonics"]
    limits: tuple[float, ...] = ()

    def for_derivative(self, highest: int) -> Harmonics:
        """The harmonics for a model that takes derivatives up to an order."""
        if not self.limits:
            return self
        limit = self.limits[min(highest, len(self.limits) - 1)]
        return self if self.orders[-1] <= limit else self.up_to(limit)

    def up_to(self, order: float) -> Harmonics:
        """The harmonics up to an order."""
        kept = self.orders <= order
        return replace(
            self,
            orders=self.orders[kept],
            coefficients=self.coefficients[kept],
            variances=self.variances[kept],
        )

    def evaluate(self, phase: Array, frequency: float, derivative: int = 0) -> Array:
        """Value or time derivative of any order at phases in cycles, exactly.

        Parameters
        ----------
        phase : ndarray, shape (N,)
            ``frequency * (t - origin)``, in cycles.
        frequency : float
            Fundamental frequency in Hz.
        derivative : int
            Order of the time derivative, 0 for the value.

        Returns
        -------
        ndarray, shape (N,)
            In the channel's SI unit per second to the power ``derivative``.
        """
        rates = (2j * np.pi * frequency * self.orders) ** derivative * self.coefficients
        if self.orders.size > 0 and derivative > 0 and self.orders[0] == 0:
            rates = rates.copy()
            rates[0] = 0.0
        values = np.empty(phase.shape)
        # Blocks keep the tables of exponentials small: they stay within the second-level cache.
        for first in range(0, phase.size, 512):
            cycles = phase[first : first + 512] % 1.0
            values[first : first + 512] = _sum_of_harmonics(cycles, self.orders, rates)
        return values


def _sum_of_harmonics(cycles: Array, orders: Integers, rates: ComplexArray) -> Array:
    """``Re sum_k rates_k exp(2 pi i k cycles)``, shape (N,).

    The exponentials take the time. Each of many is the product of one whose order is a multiple of
    ``TABLE`` and one whose order is below: as many are computed as a table has rows and columns,
    and not as it has fields. Where most fields would be empty, that is no gain.
    """
    highest = int(orders[-1]) if orders.size else 0
    if orders.size <= TABLE + highest // TABLE:  # few, or far apart
        return np.asarray((np.exp(2j * np.pi * np.outer(cycles, orders)) @ rates).real)
    high, low = np.divmod(orders, TABLE)
    table = np.zeros((TABLE, int(high[-1]) + 1), dtype=complex)
    table[low, high] = rates
    fine = np.exp(2j * np.pi * np.outer(cycles, np.arange(TABLE)))
    coarse = np.exp(2j * np.pi * np.outer(cycles, TABLE * np.arange(table.shape[1])))
    return np.asarray(np.einsum("nh,nh->n", fine @ table, coarse).real)


@dataclass(frozen=True)
class Tone:
    """A sinusoid that is no harmonic of the drive.

    Parameters
    ----------
    frequency : float
        Hz.
    amplitude : float
        SI.
    """

    frequency: float
    amplitude: float


@dataclass(frozen=True)
class Disturbances:
    """What was removed from a channel because it is no physics.

    Parameters
    ----------
    drift : float
        Root mean square of the drift about its mean, SI; zero where there was none.
    terms : int
        Slow functions that it was made of; half as many lines of the spectrum are without noise.
    tones : tuple of Tone
    degrees : float
        Degrees of freedom of the Student-t noise whose outliers were weighted down; zero where the
        noise is normal.
    drift_elsewhere : bool
        Whether the drift was not found here, but removed because the channel drifts in other runs.
    """

    drift: float = 0.0
    terms: int = 0
    tones: tuple[Tone, ...] = ()
    degrees: float = 0.0
    drift_elsewhere: bool = False

    def __bool__(self) -> bool:
        return bool(self.drift or self.tones or self.degrees)


@dataclass(frozen=True)
class Record:
    """One reduced run.

    Parameters
    ----------
    label, group, role, kind : str
        ``role`` is ``fit`` or ``hold-out``; ``kind`` is ``periodic`` or ``transient``.
    frequency, frequency_sd : float
        Refined fundamental frequency and its standard deviation, Hz; NaN for a transient.
    periods : int
        Number of whole periods kept; 0 for a transient.
    time : ndarray, shape (N,)
        Sample times, s; the first sample is the origin of phase: ``phase = frequency * (time -
        time[0])``.
    samples : mapping of str to ndarray, shape (N,)
        Raw samples of each channel over those whole periods, SI.
    harmonics : mapping of str to Harmonics
        Significant harmonics of each channel (periodic runs).
    signal_noise : mapping of str to float
        Standard deviation of a single sample about the periodic mean, of a transient about the
        smooth curve behind it, SI; not a number for a held channel of which nothing tells it.
    conditions, condition_sd : mapping of str to float
        Known constants of the run, SI; standard deviation where declared.
    dropped_periods : int
        Leading periods left out because they had not settled.
    smoothed : mapping of str to Smoothed
        The curve through each channel, with those for derivatives (transient runs).
    kept : ndarray of bool, shape (N,), optional
        Which samples count; None where all do.
    disturbances : mapping of str to Disturbances
        What was removed from channels before physics is named.
    """

    label: str
    group: str
    role: str
    kind: str
    frequency: float
    frequency_sd: float
    periods: int
    time: Float[Array, " samples"]
    samples: Mapping[str, Float[Array, " samples"]]
    harmonics: Mapping[str, Harmonics]
    signal_noise: Mapping[str, float]
    conditions: Mapping[str, float] = field(default_factory=dict)
    condition_sd: Mapping[str, float] = field(default_factory=dict)
    dropped_periods: int = 0
    smoothed: Mapping[str, Smoothed] = field(default_factory=dict)
    kept: Bool[Flags, " samples"] | None = None
    disturbances: Mapping[str, Disturbances] = field(default_factory=dict)

    @property
    def phase(self) -> Array:
        """Phase of every sample in cycles since the first one, shape (N,)."""
        return cast(Array, self.frequency * (self.time - self.time[0]))

    @property
    def periodic(self) -> bool:
        """Whether the run repeats itself."""
        return self.kind == PERIODIC

    @property
    def signals(self) -> Mapping[str, Signal]:
        """Each channel as an input: by its harmonics, or by its curve."""
        return self.harmonics if self.periodic else self.smoothed

    @property
    def span(self) -> float:
        """Duration that is solved at once, s: a period, or the length of a transient."""
        return 1.0 / self.rate

    @property
    def rate(self) -> float:
        """Reciprocal of the span, Hz."""
        if self.periodic:
            return self.frequency
        return 1.0 / float(self.time[-1] - self.time[0])

    @property
    def position(self) -> Array:
        """Every sample's place in spans since the first one, shape (N,): the phase, if periodic."""
        return cast(Array, self.rate * (self.time - self.time[0]))


def transient_record(
    label: str,
    time: Array,
    samples: Mapping[str, Array],
    *,
    conditions: Mapping[str, float] | None = None,
) -> Record:
    """A record of a motion that does not repeat, from arrays.

    Parameters
    ----------
    label : str
        Of the run.
    time : ndarray, shape (N,)
        Equidistant sample times, s.
    samples : mapping of str to ndarray, shape (N,)
        Of each channel, SI.
    conditions : mapping of str to float, optional
        Known constants of the run, SI.

    Returns
    -------
    Record
        With the curve through each channel, and its noise.

    Raises
    ------
    CampaignError
        If times are not equidistant, or samples are missing or not finite.
    """
    time = np.asarray(time, dtype=float)
    gaps = np.diff(time)
    # Times written with seven digits are as equidistant as files have them.
    if not (time.size >= FEWEST_SAMPLES and np.ptp(gaps) <= 1e-6 * time[-1] and gaps.min() > 0):
        raise CampaignError(
            "a transient needs equidistant times",
            run=label,
            value=time[:4].tolist(),
            hint=f"give at least {FEWEST_SAMPLES}",
        )
    columns = {name: np.asarray(values, dtype=float) for name, values in samples.items()}
    for name, values in columns.items():
        if values.shape != time.shape or not np.isfinite(values).all():
            raise CampaignError(
                "a channel needs one finite number for each time", run=label, column=name
            )
    step = float((time[-1] - time[0]) / (time.size - 1))
    smoothed = band_limited_channels(columns, step)
    return Record(
        label=label,
        group="",
        role="fit",
        kind=TRANSIENT,
        frequency=np.nan,
        frequency_sd=np.nan,
        periods=0,
        time=time,
        samples=columns,
        harmonics={},
        signal_noise={name: sample_noise(values, step) for name, values in columns.items()},
        conditions=dict(conditions or {}),
        smoothed=smoothed,
    )
