"""Small systems whose truth is known, measured with known noise: campaigns for the statistics of
what is said about them.

Six kinds: a linear and a Duffing oscillator under a measured force, the force law of a damper and
an oleo under a controlled stroke, a body that is heated, and two coupled masses. True parameters
are drawn from their priors, motions are computed by SciPy or in closed form, and noise is added to
what is recorded. Nothing is missing unless an effect is asked for.

>>> made = make("linear", 7, weak=True)
>>> made.campaign, made.model, made.truth  # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from bayesoleo.data import CampaignData, ReducedCampaign, Run, reduce_campaign
from bayesoleo.data._campaign_toml import Channel
from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.systems._oleo import mechanical_oleo

Array = NDArray[np.float64]

#: Spread of a toleranced constant about its declared value, as a part of it.
TOLERANCE = 0.05
#: Tolerances of SciPy's integrator: far below the least noise, a fiftieth of a per cent of the
#: swing once it is averaged.
_RTOL, _ATOL = 1e-7, 1e-12
#: Ambient temperature of the heated body, K.
_AMBIENT = 293.0


#: Draws noise: of a generator, an output, times, a frequency and a standard deviation.
Draw = Callable[[np.random.Generator, str, Array, float, float], Array]


@dataclass(frozen=True)
class Noise:
    """What recording adds.

    Parameters
    ----------
    relative : float or None
        Standard deviation of an output's noise over that of the output; None draws one a campaign
        between 0.2 and 3 %.
    colour : float
        Coefficient of AR(1) noise; zero is white.
    relative_input : float
        The same as ``relative`` of a measured input's noise, which is white.
    step : float
        Step of the converter in standard deviations of the output's noise; zero rounds nothing.
    drawn : callable, optional
        Draws the noise of outputs instead: of the output's name, the times, the fundamental
        frequency (of a transient, about that of its input) and the noise's standard deviation.
    """

    relative: float | None = None
    colour: float = 0.0
    relative_input: float = 0.0
    step: float = 0.0
    drawn: Draw | None = None


@dataclass(frozen=True)
class Sizes:
    """Sizes of a motion: effects are scaled by them.

    Parameters
    ----------
    position, velocity, force : float
        Standard deviations over the largest fitted run, SI; of the heated body those of its
        temperature, the temperature's rate and the heat flow.
    mean : float
        Mean position.
    frequency : float
        Of that run, Hz.
    """

    position: float
    velocity: float
    force: float
    mean: float
    frequency: float


@dataclass(frozen=True)
class Extra:
    """An effect that the model does not declare: a resisting force, with states of its own or none.

    Parameters
    ----------
    force : callable
        Of position, velocity, time and own states ``z (states, ...)``; SI.
    rates : callable, optional
        Of the same: time derivatives of ``z``.
    states : int
        Their number.
    """

    force: Callable[[Array, Array, Array, Array], Array]
    rates: Callable[[Array, Array, Array, Array], Array] | None = None
    states: int = 0


#: Makes an effect to the size of a motion.
Effect = Callable[[Sizes], Extra]
#: Changes what the sensors show: of the run's label, times and channels.
Sensors = Callable[[str, Array, Mapping[str, Array]], Mapping[str, Array]]

NOTHING = Extra(lambda x, v, t, z: 0.0 * x)


@dataclass(frozen=True)
class Signal:
    """A sum of sinusoids about a mean, exact with its derivatives."""

    mean: float
    frequencies: Array
    amplitudes: Array
    phases: Array

    def at(self, time: Array, derivative: int = 0) -> Array:
        """Value or time derivative, shape of ``time``."""
        omega, amplitudes = self._omega, self.amplitudes
        turn = np.asarray(time, dtype=float)[..., None] * omega + self.phases
        if derivative == 0:  # an integrator asks for nothing else
            return np.asarray(np.sin(turn) @ amplitudes + self.mean)
        turn = turn + derivative * np.pi / 2
        return np.asarray(np.sin(turn) @ (amplitudes * omega**derivative))

    @cached_property
    def _omega(self) -> Array:
        return 2 * np.pi * self.frequencies

    def times(self, factor: float) -> Signal:
        """The same with smaller or larger swings about its mean."""
        return replace(self, amplitudes=factor * self.amplitudes)


class System:
    """One kind of system with its true constants; state ``s`` has the shape (size, ...)."""

    size = 0
    channels: ClassVar[Mapping[str, str]] = {}
    driven = ""
    controlled: str | None = None

    def __init__(self, truth: Mapping[str, float]) -> None:
        self.truth = truth

    def motion(self, s: Array, signal: Signal, t: Array) -> tuple[Array, Array]:
        """Position and velocity on which an effect acts."""
        raise NotImplementedError

    def rates(self, s: Array, signal: Signal, t: Array, resist: Array) -> Array:
        """Time derivatives of the state."""
        raise NotImplementedError

    def outputs(self, s: Array, signal: Signal, t: Array, resist: Array) -> dict[str, Array]:
        """What is measured besides the driving channel."""
        raise NotImplementedError

    @property
    def start(self) -> Array:
        """State at rest."""
        return np.zeros(self.size)


class Oscillator(System):
    """A mass on a spring with a cubic part, under a force."""

    size, driven = 2, "force"
    channels: ClassVar = {"force": "N", "displacement": "m"}

    def motion(self, s: Array, signal: Signal, t: Array) -> tuple[Array, Array]:
        return s[0], s[1]

    def rates(self, s: Array, signal: Signal, t: Array, resist: Array) -> Array:
        p = self.truth
        pull = p["damping"] * s[1] + p["stiffness"] * s[0] + p.get("cubic", 0.0) * s[0] ** 3
        return np.array([s[1], (signal.at(t) - pull - resist) / p["mass"]])

    def outputs(self, s: Array, signal: Signal, t: Array, resist: Array) -> dict[str, Array]:
        return {"displacement": s[0]}


class TwoMasses(System):
    """Two masses in a row on springs and dampers; the force acts on the first."""

    size, driven = 4, "force"
    channels: ClassVar = {"force": "N", "first": "m", "second": "m"}

    def motion(self, s: Array, signal: Signal, t: Array) -> tuple[Array, Array]:
        return s[0], s[1]

    def rates(self, s: Array, signal: Signal, t: Array, resist: Array) -> Array:
        p = self.truth
        ground = p["damping"] * s[1] + p["stiffness"] * s[0]
        between = p["coupling_damping"] * (s[1] - s[3]) + p["coupling"] * (s[0] - s[2])
        first = (signal.at(t) - ground - between - resist) / p["mass"]
        return np.array([s[1], first, s[3], between / p["second_mass"]])

    def outputs(self, s: Array, signal: Signal, t: Array, resist: Array) -> dict[str, Array]:
        return {"first": s[0], "second": s[2]}


class Heated(System):
    """A body that a power heats and that loses heat by conduction and radiation."""

    size, driven = 1, "power"
    channels: ClassVar = {"power": "W", "body": "K"}

    def motion(self, s: Array, signal: Signal, t: Array) -> tuple[Array, Array]:
        return s[0], self.rates(s, signal, t, 0.0 * s[0])[0]

    def rates(self, s: Array, signal: Signal, t: Array, resist: Array) -> Array:
        p = self.truth
        lost = p["conductance"] * (s[0] - _AMBIENT) + p["radiation"] * (s[0] ** 4 - _AMBIENT**4)
        return ((signal.at(t) - lost - resist) / p["heat_capacity"])[None]

    def outputs(self, s: Array, signal: Signal, t: Array, resist: Array) -> dict[str, Array]:
        return {"body": s[0]}

    @property
    def start(self) -> Array:
        return np.array([_AMBIENT + 30.0])


class ForceLaw(System):
    """What a damper answers to its stroke."""

    driven, controlled = "displacement", "displacement"
    channels: ClassVar = {"displacement": "m", "force": "N"}

    def motion(self, s: Array, signal: Signal, t: Array) -> tuple[Array, Array]:
        return signal.at(t), signal.at(t, 1)

    def outputs(self, s: Array, signal: Signal, t: Array, resist: Array) -> dict[str, Array]:
        p, x, v = self.truth, signal.at(t), signal.at(t, 1)
        law = p["mass"] * signal.at(t, 2) + p["damping"] * v + p["stiffness"] * x
        return {"force": law + p["cubic"] * x**3 + resist}


class Oleo(ForceLaw):
    """The mechanical oleo under a controlled stroke."""

    channels: ClassVar = {"displacement": "m", "force": "N", "pressure": "Pa"}

    def outputs(self, s: Array, signal: Signal, t: Array, resist: Array) -> dict[str, Array]:
        p, x, v = self.truth, signal.at(t), signal.at(t, 1)
        area, ambient = p["piston_area"], p["ambient_pressure"]
        gas = 4.9e5 * (1 - area * x / p["initial_volume"]) ** -p["gas_exponent"]
        friction = p["friction_base"] + p["friction_per_pressure"] * gas
        force = p["mass"] * (signal.at(t, 2) + p["gravity"]) + p["orifice_damping"] * v * np.abs(v)
        force = force + area * (gas - ambient) + friction * np.arctan(p["friction_slope"] * v)
        return {"force": force + resist, "pressure": gas - ambient}


# -- models, as a user would declare them ----------------------------------------------------------


def _positive(value: float, unit: str, spread: float) -> Parameter:
    """Known to a part of its value; a tenth of it is the least that makes sense."""
    return Parameter(value, unit, relative_sd=spread, bounds=(0.1 * value, 10 * value))


def _constant(value: float, unit: str, toleranced: bool) -> Parameter:
    return Parameter(value, unit, fixed=True, relative_sd=TOLERANCE if toleranced else None)


def _oscillator(toleranced: bool, cubic: bool) -> Model:
    parameters = {
        "mass": _constant(1.2, "kg", toleranced),
        # Twice as much with the cubic spring, or it would have several answers.
        "damping": _positive(24.0 if cubic else 12.0, "N*s/m", 0.5),
        "stiffness": _positive(2e4, "N/m", 0.3),
    }
    terms = {
        "inertia": "mass*ddot(position)",
        "damping": "damping*dot(position)",
        "spring": "stiffness*position",
        "excitation": "-force",
    }
    if cubic:
        parameters["cubic"] = _positive(3e9, "N/m**3", 0.5)
        terms["hardening"] = "cubic*position**3"
    return Model(
        "duffing oscillator" if cubic else "linear oscillator",
        inputs={"force": "N"},
        dofs={"position": Dof("m")},
        parameters=parameters,
        equations={"position": terms},
        outputs={"displacement": Output("position", "m")},
    )


def _two_masses(toleranced: bool) -> Model:
    between = "coupling_damping*({0}dot(first_position) - {0}dot(second_position))"
    between += " + coupling*({0}first_position - {0}second_position)"
    between = between.replace("{0}", "")
    return Model(
        "two masses",
        inputs={"force": "N"},
        dofs={"first_position": Dof("m"), "second_position": Dof("m")},
        parameters={
            "mass": _constant(2.0, "kg", toleranced),
            "second_mass": _constant(1.0, "kg", False),
            "damping": _positive(15.0, "N*s/m", 0.5),
            "stiffness": _positive(2e4, "N/m", 0.3),
            "coupling_damping": _positive(8.0, "N*s/m", 0.5),
            "coupling": _positive(1.5e4, "N/m", 0.3),
        },
        equations={
            "first_position": "mass*ddot(first_position) + damping*dot(first_position)"
            f" + stiffness*first_position + {between} - force",
            "second_position": f"second_mass*ddot(second_position) - ({between})",
        },
        outputs={"first": Output("first_position", "m"), "second": Output("second_position", "m")},
    )


def _heated(toleranced: bool) -> Model:
    ambient = f"{_AMBIENT:g}"
    return Model(
        "heated body",
        inputs={"power": "W"},
        dofs={"temperature": Dof("K", guess=_AMBIENT + 30.0)},
        parameters={
            "heat_capacity": _positive(500.0, "J/K", 0.4),
            "conductance": _positive(2.0, "W/K", 0.4),
            "radiation": _constant(2e-9, "W/K**4", toleranced),
        },
        equations={
            "temperature": "heat_capacity*dot(temperature)"
            f" + conductance*(temperature - {ambient})"
            f" + radiation*(temperature**4 - {ambient}**4) - power"
        },
        outputs={"body": Output("temperature", "K")},
    )


def _force_law(toleranced: bool) -> Model:
    return Model(
        "damper",
        inputs={"displacement": "m"},
        parameters={
            "mass": _constant(0.5, "kg", toleranced),
            "damping": _positive(200.0, "N*s/m", 0.5),
            "stiffness": _positive(1000.0, "N/m", 0.5),
            "cubic": _positive(2e6, "N/m**3", 0.5),
        },
        outputs={
            "force": Output(
                {
                    "inertia": "mass*ddot(displacement)",
                    "damping": "damping*dot(displacement)",
                    "stiffness": "stiffness*displacement",
                    "cubic": "cubic*displacement**3",
                },
                "N",
            )
        },
    )


def _oleo(toleranced: bool) -> Model:
    model = mechanical_oleo(2)
    damping = model.parameters["orifice_damping"]
    spread = TOLERANCE if toleranced else None
    known = Parameter(damping.value, damping.unit, fixed=True, relative_sd=spread)
    return model.with_parameters(orifice_damping=known)


# -- kinds: what is measured on each ---------------------------------------------------------------


@dataclass(frozen=True)
class Kind:
    """A kind of system and the ranges that its runs are chosen from.

    Parameters
    ----------
    make : callable
        The model; whether a constant is known to a tolerance only.
    system : type of System
    mean : float
        Of the driving channel, SI.
    modest, large : tuple of (low, high) of frequency in Hz, (low, high) of amplitude in SI
        Runs that say little of some parameters, and runs that depend on all of them.
    """

    make: Callable[[bool], Model]
    system: type[System]
    mean: float
    modest: tuple[tuple[float, float], tuple[float, float]]
    large: tuple[tuple[float, float], tuple[float, float]]


KINDS: dict[str, Kind] = {
    # Resonance about 20 Hz: slow runs know the stiffness only.
    "linear": Kind(
        lambda t: _oscillator(t, False), Oscillator, 0.0,
        ((1.5, 4.0), (10.0, 40.0)), ((12.0, 30.0), (10.0, 40.0)),
    ),
    # Small runs hardly know the cubic part: it is a hundredth of the linear one at 6 N.
    "duffing": Kind(
        lambda t: _oscillator(t, True), Oscillator, 0.0,
        ((2.0, 6.0), (4.0, 8.0)), ((4.0, 8.0), (12.0, 22.0)),
    ),
    "two dofs": Kind(
        _two_masses, TwoMasses, 0.0,
        ((1.5, 4.0), (10.0, 40.0)), ((9.0, 28.0), (10.0, 40.0)),
    ),
    # Time constant about 200 s: slow runs know the conductance only.
    "thermal": Kind(
        _heated, Heated, 90.0,
        ((6e-5, 1.5e-4), (20.0, 40.0)), ((5e-4, 3e-3), (30.0, 60.0)),
    ),
    "force law": Kind(
        _force_law, ForceLaw, 0.0,
        ((0.5, 1.5), (0.002, 0.004)), ((1.0, 3.0), (0.008, 0.014)),
    ),
    "oleo": Kind(
        _oleo, Oleo, 0.11,
        ((0.3, 0.8), (0.010, 0.020)), ((0.8, 1.6), (0.025, 0.050)),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Plan:
    """How much is measured; what is None is drawn for each campaign.

    Parameters
    ----------
    fitted, held_out : int or None
        Numbers of runs: 2 to 4 and 1 to 2, unless said otherwise.
    periods : int or None
        Of a periodic run: 4 to 8.
    per_period : float or None
        Samples of a period: 60 to 150, not whole.
    weak : bool
        Fitted runs say little of what held-out runs depend on.
    transient : bool
        Runs that do not repeat, of 300 to 800 samples, from rest.
    broadband : bool or None
        Inputs with eight harmonics instead of two; None tosses a coin for each run.
    """

    fitted: int | None = None
    held_out: int | None = None
    periods: int | None = None
    per_period: float | None = None
    weak: bool = False
    transient: bool = False
    broadband: bool | None = None


#: Two or three short periods.
FEW = Plan(periods=3, per_period=24.3)


@dataclass(frozen=True)
class Made:
    """A campaign whose truth is known.

    Parameters
    ----------
    kind : str
    campaign : ReducedCampaign
    model : Model
        As declared, without the extra effect.
    truth : mapping of str to float
        Every constant of the model, SI.
    noise : mapping of str to float
        Standard deviation of the noise of a sample by output, SI.
    sizes : Sizes
    clean : mapping of str to mapping of str to ndarray
        What was there, by run and channel, without noise.
    """

    kind: str
    campaign: ReducedCampaign
    model: Model
    truth: Mapping[str, float]
    noise: Mapping[str, float]
    sizes: Sizes
    clean: Mapping[str, Mapping[str, Array]] = field(repr=False, default_factory=dict)


@cache
def model_of(kind: str, toleranced: bool = False) -> Model:
    """The declared model of a kind; with a constant that is known to 5 % only, or exactly."""
    return KINDS[kind].make(toleranced)


def make(
    kind: str,
    seed: int,
    *,
    plan: Plan = Plan(),
    weak: bool | None = None,
    noise: Noise = Noise(),
    toleranced: bool = False,
    effect: Effect | None = None,
    sensors: Sensors | None = None,
    model: Model | None = None,
    within: float = 2.0,
) -> Made:
    """Draw a system and measure it.

    Parameters
    ----------
    kind : str
        One of :data:`KINDS`.
    seed : int
        Everything random follows from kind and seed; noise does not change truth or runs.
    plan : Plan
        How much is measured.
    weak : bool, optional
        Instead of the plan's.
    noise : Noise
        What recording adds.
    toleranced : bool
        Declare one constant to a tolerance of 5 % and draw its true value from it; otherwise it is
        known exactly.
    effect : callable, optional
        Makes a resisting force (of the heated body: a heat loss) that the model does not declare.
    sensors : callable, optional
        Changes the channels before noise is added.
    model : Model, optional
        Declared instead of the kind's own, over the same channels.
    within : float
        Standard deviations of the priors within which constants are drawn. Beyond two nobody would
        trust the linearised statistics of any tool; the coverage of intervals is defined without.

    Returns
    -------
    Made
    """
    which, declared = KINDS[kind], model_of(kind, toleranced)
    truth_rng, plan_rng, noise_rng = (
        np.random.default_rng([seed, list(KINDS).index(kind), part]) for part in range(3)
    )
    truth = _drawn(declared, truth_rng, within)
    system = which.system(truth)
    plan = plan if weak is None else replace(plan, weak=weak)
    runs = _runs(which, plan, plan_rng)
    runs, sizes, clean = _simulated(system, runs, effect)
    if sensors is not None:
        clean = {run.label: dict(sensors(run.label, run.time, clean[run.label])) for run in runs}
    relative = 10 ** plan_rng.uniform(-2.7, -1.5) if noise.relative is None else noise.relative
    level = {
        name: relative * float(np.mean([np.std(values[name]) for values in clean.values()]))
        for name in system.channels
    }
    measured = {
        run.label: _measured(system, run, clean[run.label], level, relative, noise, noise_rng)
        for run in runs
    }
    campaign = _campaign(kind, system, runs, measured)
    outputs = {name: sd for name, sd in level.items() if name != system.driven}
    return Made(kind, campaign, model or declared, truth, outputs, sizes, clean)


def _drawn(model: Model, rng: np.random.Generator, within: float) -> dict[str, float]:
    """Constants from their priors, within some standard deviations."""
    truth = {}
    for name, parameter in model.parameters.items():
        prior, value = parameter.prior, parameter.value
        if prior is not None:
            while True:
                value = float(prior.sample(rng, 1)[0])
                low, high = prior.support
                if low < value < high and abs(value - prior.mean) < within * prior.sd:
                    break
        truth[name] = value
    return truth


@dataclass(frozen=True)
class _Run:
    label: str
    role: str
    frequency: float | None
    base: float
    signal: Signal
    time: Array


def _runs(kind: Kind, plan: Plan, rng: np.random.Generator) -> list[_Run]:
    fitted = int(rng.integers(2, 5)) if plan.fitted is None else plan.fitted
    held_out = int(rng.integers(1, 3)) if plan.held_out is None else plan.held_out
    made = []
    for k in range(fitted + held_out):
        role = "fit" if k < fitted else "hold-out"
        (low, high), sizes = kind.modest if plan.weak and role == "fit" else kind.large
        base = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        amplitude = float(rng.uniform(*sizes))
        signal = _signal(kind, plan, base, amplitude, rng)
        if plan.transient:
            cycles = rng.uniform(5.0, 9.0)
            time = np.linspace(0.0, cycles / base, int(cycles * rng.uniform(60.0, 90.0)))
        else:
            periods = int(rng.integers(4, 9)) if plan.periods is None else plan.periods
            rate = rng.uniform(60.0, 150.0) if plan.per_period is None else plan.per_period
            time = np.arange(int(np.ceil(periods * rate))) / (rate * base)
        frequency = None if plan.transient else base
        made.append(_Run(f"{role} {k + 1}", role, frequency, base, signal, time))
    return made


def _signal(
    kind: Kind, plan: Plan, base: float, amplitude: float, rng: np.random.Generator
) -> Signal:
    """Two or eight sinusoids; without a common period where nothing is to repeat."""
    wide = bool(rng.integers(2)) if plan.broadband is None else plan.broadband
    # Fifteen samples and more for each cycle of the fastest, if it does not repeat.
    orders = np.arange(1.0, (5.0 if plan.transient else 9.0) if wide else 3.0)
    sizes = orders**-0.5 if wide else np.array([1.0, 0.15])
    if kind.system in (ForceLaw, Oleo):
        sizes = sizes / orders  # a rig moves less where it moves fast
    if plan.transient:
        orders = orders * rng.uniform(0.8, 1.2, orders.size)
    sizes = amplitude * sizes / np.sqrt(np.sum(sizes**2))
    return Signal(kind.mean, base * orders, sizes, rng.uniform(0, 2 * np.pi, orders.size))


@dataclass(frozen=True)
class _Motion:
    """Channels of a run, and the motion on which an effect acts."""

    channels: dict[str, Array]
    position: Array
    velocity: Array


class _WildError(RuntimeError):
    """A motion that does not come back after a period."""


def _simulated(
    system: System, runs: list[_Run], effect: Effect | None
) -> tuple[list[_Run], Sizes, dict[str, dict[str, Array]]]:
    """Channels by run, without noise; driven less where the motion does not repeat."""
    for _ in range(6):
        try:
            plain = {run.label: _plain(system, run) for run in runs}
            sizes = _sizes(plain, runs)
            if effect is None:
                return runs, sizes, {label: found.channels for label, found in plain.items()}
            extra = effect(sizes)
            found = {run.label: _channels(system, run, extra).channels for run in runs}
        except _WildError:
            runs = [replace(run, signal=run.signal.times(0.6)) for run in runs]
        else:
            return runs, sizes, found
    raise RuntimeError("no motion repeats, however small")


def _sizes(plain: Mapping[str, _Motion], runs: Sequence[_Run]) -> Sizes:
    """Of the fitted run that swings most, without the extra effect."""
    fitted = [run for run in runs if run.role == "fit"]
    run = max(fitted, key=lambda run: float(np.std(plain[run.label].position)))
    found = plain[run.label]
    force = found.channels["power" if "power" in found.channels else "force"]
    position, velocity = float(np.std(found.position)), float(np.std(found.velocity))
    mean = float(np.mean(found.position))
    return Sizes(position, velocity, float(np.std(force)), mean, run.base)


#: Motions without an extra effect that were made last.
_LAST: dict[tuple[object, ...], _Motion] = {}


def _plain(system: System, run: _Run) -> _Motion:
    """A run without an extra effect, which a campaign with effects of several sizes asks for
    again."""
    signal = run.signal
    arrays = (signal.frequencies, signal.amplitudes, signal.phases, run.time)
    truth = tuple(sorted(system.truth.items()))
    key = (type(system), truth, run.frequency, signal.mean, *(a.tobytes() for a in arrays))
    if key not in _LAST:
        while len(_LAST) > 8:
            del _LAST[next(iter(_LAST))]
        _LAST[key] = _channels(system, run, NOTHING)
    return _LAST[key]


def _channels(system: System, run: _Run, extra: Extra) -> _Motion:
    s, z = _states(system, run, extra)
    x, v = system.motion(s, run.signal, run.time)
    resist = extra.force(x, v, run.time, z)
    found = system.outputs(s, run.signal, run.time, resist)
    return _Motion({system.driven: run.signal.at(run.time), **found}, x, v)


def _states(system: System, run: _Run, extra: Extra) -> tuple[Array, Array]:
    """The system's states and the effect's, each ``(states, N)``: of a transient from rest, else
    once they repeat."""
    size, total = system.size, system.size + extra.states
    if total == 0:
        empty = np.zeros((0, run.time.size))
        return empty, empty

    def rates(t: float, y: Array) -> Array:
        table = y.reshape(total, -1)
        s, z, now = table[:size], table[size:], np.array(t)
        x, v = system.motion(s, run.signal, now)
        parts = []
        if size:
            parts.append(system.rates(s, run.signal, now, extra.force(x, v, now, z)))
        if extra.rates is not None:
            shape = (extra.states, table.shape[1])
            parts.append(np.broadcast_to(extra.rates(x, v, now, z), shape))
        return np.concatenate(parts).ravel()

    start, time = np.concatenate([system.start, np.zeros(extra.states)]), run.time
    if run.frequency is not None:
        period = 1.0 / run.frequency
        start, time = _repeating(rates, start, period), time % period
    order = np.argsort(time)
    found = np.empty((total, time.size))
    found[:, order] = _integrated(rates, start, (0.0, float(time.max())), time[order])
    return found[:size], found[size:]


def _integrated(
    rates: Callable[[float, Array], Array],
    start: Array,
    span: tuple[float, float],
    time: Array | None = None,
) -> Array:
    """States at times, or at the end of a span, of one start ``(n,)`` or several ``(n, k)``."""
    found = solve_ivp(
        rates, span, start.ravel(), "DOP853", time, rtol=_RTOL, atol=_ATOL * (1 + abs(start)).max()
    )
    if not found.success:
        raise RuntimeError(found.message)
    if time is not None:
        return np.asarray(found.y)
    end: Array = found.y[:, -1].reshape(start.shape)
    return end


def _repeating(rates: Callable[[float, Array], Array], start: Array, period: float) -> Array:
    """A state that comes back after a period: it settles, and Newton's method with differences
    shortens the wait where it is near."""
    state, seen, settle = start, np.abs(start), True
    for _ in range(30):
        if settle:
            state = _integrated(rates, state, (0.0, 4 * period))
        seen = np.maximum(seen, np.abs(state))
        step = 1e-4 * (1e-6 + seen)
        starts = np.concatenate([state[:, None], state[:, None] + np.diag(step)], axis=1)
        ends = _integrated(rates, starts, (0.0, period))
        gap = ends[:, 0] - state
        if np.all(np.abs(gap) < 1e-6 * (1e-6 + seen)):
            return state
        slope = (ends[:, 1:] - ends[:, :1]) / step
        change = np.linalg.solve(np.eye(state.size) - slope, gap)
        settle = not bool(np.all(np.abs(change) < 0.5 * seen))
        if not settle:
            state = state + change
    raise _WildError("the motion does not repeat")


def _measured(
    system: System,
    run: _Run,
    clean: Mapping[str, Array],
    level: Mapping[str, float],
    relative: float,
    noise: Noise,
    rng: np.random.Generator,
) -> dict[str, Array]:
    found = {}
    for name, values in clean.items():
        if name == system.driven:
            ratio = noise.relative_input / relative
            found[name] = values + ratio * level[name] * rng.standard_normal(values.size)
            continue
        if noise.drawn is not None:
            found[name] = values + noise.drawn(rng, name, run.time, run.base, level[name])
            continue
        noisy = values + level[name] * _coloured(rng, values.size, noise.colour)
        step = noise.step * level[name]
        found[name] = step * np.round(noisy / step) if step else noisy
    return found


def _coloured(rng: np.random.Generator, size: int, coefficient: float) -> Array:
    """AR(1) noise of unit variance."""
    white = rng.standard_normal(size)
    for k in range(1, size if coefficient else 0):
        white[k] = coefficient * white[k - 1] + np.sqrt(1 - coefficient**2) * white[k]
    return white


def _campaign(
    kind: str,
    system: System,
    runs: Sequence[_Run],
    measured: Mapping[str, Mapping[str, Array]],
) -> ReducedCampaign:
    """As if loaded from files: what stands in them is tested elsewhere."""
    channels: ClassVar = {
        name: Channel(name, name, unit, unit) for name, unit in system.channels.items()
    }
    loaded = tuple(
        Run(
            run.label,
            f"{run.label}.csv",
            "",
            run.role,
            "transient" if run.frequency is None else "periodic",
            run.frequency,
            run.time,
            measured[run.label],
        )
        for run in runs
    )
    campaign = CampaignData(
        kind, "", system.controlled, Path("simulated"), channels, loaded, "0" * 64
    )
    return reduce_campaign(campaign, jobs=1)
