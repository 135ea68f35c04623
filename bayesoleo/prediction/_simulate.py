"""Simulate a run: the response of a model to a known periodic motion, sampled as on a rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from bayesoleo._types import Array, Float
from bayesoleo.errors import InputError
from bayesoleo.model._expressions import COSINE, SINE, WITHIN
from bayesoleo.model._model import Model
from bayesoleo.prediction._periodic_run import RunPredictor
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Harmonics, Record
from bayesoleo.prediction._run_errors import motion_error
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._schemes import COLLOCATION, DEFAULT_SCHEME

#: Steps of the mesh: data must be finer than what is fitted to them.
STEPS = 1024


def motion(mean: float, amplitudes: Sequence[float], phases: Sequence[float] = ()) -> Harmonics:
    """Periodic signal ``mean + sum_k a_k cos(2 pi k f t + phi_k)`` with ``k = 1, 2, …``.

    Parameters
    ----------
    mean : float
        In the channel's SI unit.
    amplitudes : sequence of float, length K
        In that unit, from the fundamental on; zeros may stand between.
    phases : sequence of float, up to K
        Radians; those not given are zero.

    Raises
    ------
    InputError
        If there are more phases than amplitudes, or a number is not finite.

    Examples
    --------
    >>> motion(0.1, [0.02]).evaluate(np.array([0.0, 0.5]), 1.0).round(3).tolist()
    [0.12, 0.08]
    """
    if len(phases) > len(amplitudes):
        raise InputError("more phases than amplitudes", key="phases", value=list(phases))
    given = [mean, *amplitudes, *phases]
    if not np.isfinite(given).all():
        raise InputError("a motion needs finite numbers", value=given)
    turned = np.zeros(len(amplitudes))
    turned[: len(phases)] = phases
    coefficients = np.concatenate(([mean], np.asarray(amplitudes) * np.exp(1j * turned)))
    return Harmonics(np.arange(coefficients.size), coefficients, np.zeros(coefficients.size))


@dataclass(frozen=True)
class RunPlan:
    """A run to be simulated.

    Parameters
    ----------
    label : str
        Of the run.
    frequency : float
        Fundamental, Hz.
    inputs : mapping of str to Harmonics
        One for each of the model's inputs, SI; see :func:`motion`.
    conditions : mapping of str to float
        Known constants, SI; those with a default may be left out.
    periods : float
        Length of the record; need not be whole.
    samples_per_period : float
        Need not be whole either.
    phase : float
        Where the record starts, in cycles of the motion.
    group, role : str
        As in a campaign.
    """

    label: str
    frequency: float
    inputs: Mapping[str, Harmonics]
    conditions: Mapping[str, float] = field(default_factory=dict)
    periods: float = 4.0
    samples_per_period: float = 500.0
    phase: float = 0.0
    group: str = ""
    role: str = "fit"

    def __post_init__(self) -> None:
        for name in ("frequency", "periods", "samples_per_period"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                hint = "write a positive, finite number"
                raise InputError(
                    "cannot simulate", run=self.label, key=name, value=value, hint=hint
                )
        if round(self.periods * self.samples_per_period) < 2:
            raise InputError("fewer than two samples", run=self.label, hint="ask for more periods")
        if not np.isfinite(self.phase):
            raise InputError("cannot simulate", run=self.label, key="phase", value=self.phase)

    @property
    def time(self) -> Array:
        """Sample times from zero, s, shape (N,)."""
        count = round(self.periods * self.samples_per_period)
        return np.arange(count) / (self.samples_per_period * self.frequency)


@dataclass(frozen=True)
class Simulation:
    """A simulated run.

    Parameters
    ----------
    label, group, role : str
        As planned.
    frequency : float
        The true one, Hz.
    time : ndarray, shape (N,)
        From zero, s.
    samples : mapping of str to ndarray, shape (N,)
        All inputs and outputs of the model, SI, with noise where asked for.
    conditions : mapping of str to float
        SI.
    run : RunPredictor, optional
        By which it was made.
    """

    label: str
    group: str
    role: str
    frequency: float
    time: Float[Array, " samples"]
    samples: Mapping[str, Float[Array, " samples"]]
    conditions: Mapping[str, float]
    run: RunPredictor | None = field(default=None, repr=False, compare=False)

    @property
    def error(self) -> float:
        """Estimated largest error of the motion over its swing, looked for between the steps too.

        It is estimated when it is asked for. Zero of a model without dofs; NaN where there is no
        estimate.
        """
        if self.run is None:
            return float("nan")
        if not self.run.kernels.derived.dofs:
            return 0.0
        return motion_error(self.run).error


def simulate_run(
    model: Model,
    plan: RunPlan,
    values: Mapping[str, float] | None = None,
    *,
    noise: Mapping[str, float] | None = None,
    quantisation: Mapping[str, float] | None = None,
    rng: np.random.Generator | None = None,
    steps: int = STEPS,
    scheme: str = DEFAULT_SCHEME,
    solver: str = COLLOCATION,
    backend: str = "numpy",
) -> Simulation:
    """Simulate one periodic run.

    Parameters
    ----------
    model : Model
        In the drive in which it is solved.
    plan : RunPlan
        Motion, conditions and sampling.
    values : mapping of str to float, optional
        Parameters that are not at their nominal value.
    noise : mapping of str to float, optional
        Standard deviation of white Gaussian noise by channel, SI; inputs are measured too.
    quantisation : mapping of str to float, optional
        Step by channel, SI, to whose multiples the noisy samples are rounded.
    rng : numpy.random.Generator, optional
        Needed for noise.
    steps, scheme, solver, backend
        See :class:`~bayesoleo.prediction.Predictor`; NumPy's kernels need no compilation.

    Returns
    -------
    Simulation

    Raises
    ------
    InputError
        If a name is unknown, an input or a condition is missing, or the model cannot be solved for
        this motion and these values.
    """
    noise, quantisation, values = noise or {}, quantisation or {}, values or {}
    check_plan(model, plan, values)
    _check_channels(model, plan, noise, quantisation, rng)
    clean, run = _clean_samples(model, plan, values, steps, scheme, solver, backend)
    samples = {}
    for name, x in clean.items():
        if noise.get(name, 0.0) > 0 and rng is not None:
            x = x + noise[name] * rng.standard_normal(x.size)
        if name in quantisation:
            x = quantisation[name] * np.round(x / quantisation[name])
        samples[name] = x
    return Simulation(
        plan.label,
        plan.group,
        plan.role,
        plan.frequency,
        plan.time,
        samples,
        dict(plan.conditions),
        run,
    )


def check_plan(model: Model, plan: RunPlan, values: Mapping[str, float]) -> None:
    """Refuse names that the model does not have, and plans that lack an input or a condition."""
    for name in values:
        if name not in model.parameters:
            hint = f"parameters there are: {', '.join(model.parameters)}"
            raise InputError("no such parameter", run=plan.label, key=name, hint=hint)
    for name in _moved(model):
        if name not in plan.inputs:
            raise InputError(
                f"model {model.name!r} needs the input {name!r}",
                run=plan.label,
                value=sorted(plan.inputs),
                hint=f"give inputs={{{name!r}: motion(…)}}, or drive the model by another channel",
            )
    for name, condition in model.conditions.items():
        if name not in plan.conditions and condition.default is None:
            hint = f"give conditions={{{name!r}: …}} in {condition.unit or 'its unit'}"
            raise InputError(f"no condition {name!r}", run=plan.label, hint=hint)


def _moved(model: Model) -> tuple[str, ...]:
    """Inputs that a plan states; those that turn with another one follow from it."""
    return tuple(
        name for name in model.inputs if not name.startswith((COSINE + WITHIN, SINE + WITHIN))
    )


def _check_channels(
    model: Model,
    plan: RunPlan,
    noise: Mapping[str, float],
    quantisation: Mapping[str, float],
    rng: np.random.Generator | None,
) -> None:
    channels = (*model.inputs, *model.outputs)
    for what, table in (("noise", noise), ("quantisation", quantisation)):
        for name, value in table.items():
            if name not in channels:
                hint = f"channels there are: {', '.join(channels)}"
                raise InputError(f"{what} of no channel", run=plan.label, key=name, hint=hint)
            if not (np.isfinite(value) and (value > 0 or (value == 0 and table is noise))):
                hint = "write a positive number in the channel's SI unit"
                raise InputError(what, run=plan.label, key=name, value=value, hint=hint)
    if any(noise.values()) and rng is None:
        raise InputError("noise needs a generator", hint="pass rng=np.random.default_rng(seed)")


def _clean_samples(
    model: Model,
    plan: RunPlan,
    values: Mapping[str, float],
    steps: int,
    scheme: str,
    solver: str,
    backend: str,
) -> tuple[dict[str, Array], RunPredictor]:
    """All channels without noise, inputs first, and what they were made by."""
    record = record_of(model, plan)
    inputs = {name: record.samples[name] for name in _moved(model)}
    predictor = Predictor(
        model, [record], steps=steps, scheme=scheme, solver=solver, backend=backend, jobs=1
    )
    run = predictor.runs[0]
    p = run.base_constants()
    for name, value in values.items():
        p[run.kernels.derived.constants.index(name)] = value
    status = run.set_anchor(p)
    if status.ok:
        answer = run.predict(p[None])
        status = Status(int(answer.status[0]))
    if not status.ok:
        raise InputError(
            f"model {model.name!r}: no periodic answer to this motion was found: {status.message}",
            run=plan.label,
            hint="change the motion, the conditions or the parameter values",
        )
    return inputs | dict(zip(run.kernels.derived.outputs, answer.y[0], strict=True)), run


def record_of(model: Model, plan: RunPlan) -> Record:
    """A record of the inputs alone, as a predictor takes it; phase counts from its first sample."""
    time = plan.time
    turned = {name: _turned(plan.inputs[name], plan.phase) for name in _moved(model)}
    samples = {
        name: item.evaluate(plan.frequency * time, plan.frequency) for name, item in turned.items()
    }
    samples |= {name: np.zeros(time.size) for name in model.outputs}
    return Record(
        label=plan.label,
        group=plan.group,
        role=plan.role,
        kind="periodic",
        frequency=plan.frequency,
        frequency_sd=0.0,
        periods=int(plan.periods),
        time=time,
        samples=samples,
        harmonics=turned,
        signal_noise=dict.fromkeys(samples, 0.0),
        conditions=plan.conditions,
    )


def _turned(item: Harmonics, phase: float) -> Harmonics:
    """The same signal with its origin moved on by a phase in cycles."""
    turn = np.exp(2j * np.pi * item.orders * (phase % 1.0))
    return Harmonics(item.orders, item.coefficients * turn, item.variances)
