"""Whether a solver's word holds: 120 solves whose answers are known to 1e-10.

Twenty problems, each by the five ways to a periodic motion and once as a transient from rest.
References are none of the package's: transfer functions of Fourier coefficients where the
equations are linear in the states, exact flows between contacts where they are linear piece by
piece, and SciPy's DOP853 at 1e-13 with Newton's method elsewhere. A nonlinear problem may have
several periodic motions; the reference is that nearest to what the solver found, refined from its
first state, or the one refined from rest, whichever is closer.

A solve is *silently wrong* if its status says that it may be used while a state is off by more
than ten times both the tolerance asked for and the estimated error, in units of the state's swing.
Times count alike: where a state jumps, as at a stiff stop, a sample may be late by that part of a
period. ``said_unsure`` are solves that give a motion and say that it misses the tolerance,
``failed`` those that give none.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import cos, pi, tanh

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

from bayesoleo.model import Dof, Model, Parameter
from bayesoleo.model._kernels import kernels
from bayesoleo.prediction._orbits import periodic_orbit
from bayesoleo.prediction._records import Harmonics, Record
from bayesoleo.prediction._run_errors import TOLERANCE as KNOWN, motion_error
from bayesoleo.prediction._simulate import RunPlan, motion
from bayesoleo.prediction._transient_run import TransientRun
from bayesoleo.solvers._schemes import SOLVERS
from bayesoleo.solvers._switched import state_rows

Array = np.ndarray
Rates = Callable[[float, Array], tuple[float, ...]]
#: Samples of a period from which Fourier coefficients are taken, and those of them at which motions
#: are compared: never at a node of a mesh of equal steps, where errors are least.
COUNT = 2**18
PHASES = (256 * np.arange(1024) + 101) / COUNT
#: Beyond so many times what was asked for and what was estimated an error is a silent one.
FACTOR = 10.0
#: Asked for of periodic motions, and of LSODA, which takes minutes for more.
TOLERANCE, OF_LIBRARY = 1e-8, 1e-6


@dataclass(frozen=True)
class Case:
    """One problem, with a period of a second.

    Parameters
    ----------
    name : str
    model : Model
        All dofs start at rest.
    force : Harmonics
        Its input.
    periodic : callable
        A state at phase zero, and a delay in cycles, to the true states at :data:`PHASES` of the
        periodic motion nearest to it: lower and upper bounds ``(2, D, N)`` of what they are within
        that delay.
    transient : callable
        A delay to the same of the motion from rest.
    """

    name: str
    model: Model
    force: Harmonics
    periodic: Callable[[Array, float], Array]
    transient: Callable[[float], Array]


def model_of(name: str, equations: Mapping[str, str]) -> Model:
    """A model whose dofs start from zero, with a dummy parameter to be estimated."""
    dofs = {dof: Dof("", initial="0") for dof in equations}
    return Model(
        name,
        inputs={"u": "1"},
        dofs=dofs,
        parameters={"one": Parameter(1.0, sd=0.1)},
        equations=dict(equations),
        outputs={"y": next(iter(equations))},
    )


# -- linear in the states ------------------------------------------------------------------------


def linear(
    name: str,
    equation: str,
    matrix: Array,
    gain: Array,
    force: Harmonics,
    function: Callable[[Array], Array] = lambda u: u,
) -> Case:
    """``ds/dt = matrix s + gain f(u)``: Fourier coefficients, and the exponential from rest."""
    coefficients = np.fft.rfft(function(input_of(force)))
    rate = 2j * np.pi * np.arange(coefficients.size)
    system = rate[:, None, None] * np.eye(gain.size) - matrix
    right = np.broadcast_to(gain[:, None], (rate.size, gain.size, 1))
    table = np.linalg.solve(system, right)[:, :, 0]
    states = np.stack([np.fft.irfft(coefficients * row, n=COUNT) for row in table.T])
    exact = states[:, np.round(PHASES * COUNT).astype(int)]
    step, free, away = expm(matrix / PHASES.size), [], -(expm(matrix * PHASES[0]) @ states[:, 0])
    for _ in PHASES:
        free.append(away)
        away = step @ away
    moving = exact + np.array(free).T
    return Case(
        name,
        model_of(name, {"q": equation}),
        force,
        lambda *_: np.stack([exact, exact]),
        lambda _: np.stack([moving, moving]),
    )


def input_of(force: Harmonics) -> Array:
    """The input at ``COUNT`` phases."""
    spectrum = np.zeros(COUNT // 2 + 1, dtype=complex)
    spectrum[force.orders] = force.coefficients * COUNT / 2
    spectrum[0] *= 2
    return np.fft.irfft(spectrum, n=COUNT)


def lag(tau: float, steep: float) -> Case:
    """A fast state behind a steep function of the input."""
    return linear(
        f"lag of {tau:g} s behind tanh({steep:g} u)",
        f"one*{tau}*dot(q) + q - tanh({steep}*u)",
        np.array([[-1 / tau]]),
        np.array([1 / tau]),
        motion(0.0, [1.0]),
        lambda u: np.tanh(steep * u),
    )


def oscillator(
    name: str,
    damping: float,
    stiffness: float,
    force: Harmonics,
    text: str = "u",
    function: Callable[[Array], Array] = lambda u: u,
) -> Case:
    """A unit mass on a spring."""
    return linear(
        name,
        f"one*ddot(q) + {damping}*dot(q) + {stiffness}*q - {text}",
        np.array([[0.0, 1.0], [-stiffness, -damping]]),
        np.array([0.0, 1.0]),
        force,
        function,
    )


def single(order: int, size: float) -> Harmonics:
    """A slow motion with one fast harmonic on top."""
    return motion(0.0, [1.0, *[0.0] * (order - 2), size])


# -- linear piece by piece -----------------------------------------------------------------------


@dataclass(frozen=True)
class Pieces:
    """``dv/dt = -c v - k q + b + a cos(w t)`` with constants by side of a switching function.

    Parameters
    ----------
    sides : tuple of (c, k, b)
        Below and above zero.
    switch : int
        Component of the state that switches, less ``level``.
    level, amplitude : float
    """

    sides: tuple[tuple[float, float, float], tuple[float, float, float]]
    switch: int
    level: float
    amplitude: float

    def flow(self, side: int, start: Array, t0: float) -> Callable[[Array], Array]:
        """The exact states ``(2, N)`` from a state at a time, as long as the side stays."""
        (c, k, b), w = self.sides[side], 2 * np.pi
        root = np.sqrt(complex(c * c / 4 - k))
        swing = self.amplitude / (k - w * w + 1j * c * w)
        rates = np.array([-c / 2 + root, -c / 2 - root])

        def forced(t: Array) -> Array:
            turn = swing * np.exp(1j * w * t)
            return np.array([turn.real + b / k, (1j * w * turn).real])

        away = (start - forced(np.array(t0))).astype(complex)
        weights = np.linalg.solve(np.array([[1, 1], rates]), away)

        def at(t: Array) -> Array:
            free = weights[:, None] * np.exp(rates[:, None] * (np.atleast_1d(t) - t0))
            bent = np.array([free.sum(axis=0).real, (rates[:, None] * free).sum(axis=0).real])
            return np.asarray(forced(np.atleast_1d(t)) + bent)

        return at

    def through(self, start: Array, phases: Array = PHASES) -> tuple[Array, Array]:
        """States at rising phases ``(2, N)``, and at the end of the period ``(2,)``."""
        rows, t, state = np.full((2, phases.size), np.nan), 0.0, np.array(start, dtype=float)
        side = int(self._side(state))
        for _ in range(1000):
            at = self.flow(side, state, t)
            end = self._leaves(at, side, t)
            here = (phases >= t) & (phases < end)
            rows[:, here] = at(phases[here])
            state, t = at(np.array([end]))[:, 0], end
            if end >= 1.0:
                return rows, state
            state[self.switch] = self.level
            side = 1 - side
        return rows, np.full(2, np.nan)

    def _side(self, state: Array) -> bool:
        return bool(state[self.switch] > self.level)

    def _leaves(self, at: Callable[[Array], Array], side: int, t: float) -> float:
        """When the switching function changes its sign, looked for in pieces of a thirtieth of the
        side's own half period or of a hundredth of the force's."""
        step = min(np.pi / np.sqrt(self.sides[side][1]), 0.01) / 30
        sign = 1.0 if side else -1.0

        def value(time: float) -> float:
            return float(sign * (at(np.array([time]))[self.switch, 0] - self.level))

        first = t + 1e-3 * step
        while first < 1.0:
            times = np.minimum(first + step * np.arange(1000), 1.0)
            out = np.flatnonzero(sign * (at(times)[self.switch] - self.level) < 0.0)
            if out.size and out[0] == 0:
                return float(times[0])
            if out.size:
                low, high = times[out[0] - 1], times[out[0]]
                return float(brentq(value, low, high, xtol=1e-16, rtol=1e-14))
            first = times[-1] if times[-1] < 1.0 else 1.0
        return 1.0


def piecewise(name: str, equation: str, pieces: Pieces, force: Harmonics) -> Case:
    """By exact flows between switches, with a delay for what jumps."""
    orbits = Orbits(lambda s: pieces.through(s, PHASES[:1])[1])

    def bounds(start: Array, delay: float, repeat: bool) -> Array:
        late = np.concatenate([PHASES - delay, PHASES, PHASES + delay])
        late = late % 1.0 if repeat else np.clip(late, 0.0, 1.0 - 1e-12)
        order = np.argsort(late, kind="stable")
        rows = np.empty((2, late.size))
        rows[:, order] = pieces.through(start, late[order])[0]
        three = rows.reshape(2, 3, -1)
        return np.stack([three.min(axis=1), three.max(axis=1)])

    return Case(
        name,
        model_of(name, {"q": equation}),
        force,
        lambda start, delay: bounds(orbits.nearest(start), delay, True),
        lambda delay: bounds(np.zeros(2), delay, False),
    )


class Orbits:
    """Fixed points of a time map ``end``, found once each."""

    def __init__(self, end: Callable[[Array], Array], size: int = 2):
        self.end, self.size = end, size
        self.known: list[Array] = []

    def nearest(self, start: Array) -> Array:
        """The fixed point next to a state; where none is, one to which the motion from rest
        settles. NaN if there is none either."""
        scale = np.abs(start) + 1e-2 * np.abs(start).max() + 1e-9
        for state in self.known:
            if np.max(np.abs(state - start) / scale) < 1e-3:
                return state
        found = self.closed(start, scale)
        if found is None:
            settled = np.zeros(self.size)
            for _ in range(60):
                settled = self.end(settled)
            found = self.closed(settled, scale)
        if found is None:
            return np.full(self.size, np.nan)
        self.known.append(found)
        return found

    def closed(self, start: Array, scale: Array) -> Array | None:
        """Newton's method with central differences; None where it does not get there."""
        state = np.array(start, dtype=float)
        for _ in range(20):
            slopes = np.empty((self.size, self.size))
            for j in range(self.size):
                away = np.zeros(self.size)
                away[j] = 1e-6 * scale[j]
                slopes[:, j] = (self.end(state + away) - self.end(state - away)) / (2 * away[j])
            if not np.isfinite(slopes).all():
                return None
            step = np.linalg.solve(np.eye(self.size) - slopes, self.end(state) - state)
            if not np.isfinite(step).all():
                return None
            state = state + step
            # Round-off of the closure at a lightly damped resonance is a thousand of its units.
            if np.max(np.abs(step) / scale) < 3e-12:
                return state
        return state if np.max(np.abs(step) / scale) < 1e-10 else None


def end_stop(stiffness: float) -> Case:
    """A mass on a spring that strikes a stop."""
    c, k, gap, amplitude = 4.0, 60.0, 0.02, 6.0
    pieces = Pieces(((c, k, 0.0), (c, k + stiffness, stiffness * gap)), 0, gap, amplitude)
    return piecewise(
        f"stop of {stiffness:g}",
        f"one*ddot(q) + {c}*dot(q) + {k}*q + {stiffness}*max(q - {gap}, 0) - u",
        pieces,
        motion(0.0, [amplitude]),
    )


def dry_friction() -> Case:
    """Coulomb friction small enough that nothing sticks."""
    c, k, friction, amplitude = 0.5, 60.0, 1.0, 8.0
    pieces = Pieces(((c, k, friction), (c, k, -friction)), 1, 0.0, amplitude)
    return piecewise(
        "dry friction",
        f"one*ddot(q) + {c}*dot(q) + {k}*q + {friction}*sign(dot(q)) - u",
        pieces,
        motion(0.0, [amplitude]),
    )


# -- anything else -------------------------------------------------------------------------------


def integrated(
    name: str, equations: Mapping[str, str], rates: Rates, size: int, force: Harmonics
) -> Case:
    """By DOP853 at 1e-13."""

    def run(start: Array, at: Array | None) -> Array:
        found = solve_ivp(
            rates, (0.0, 1.0), start, "DOP853", rtol=1e-13, atol=1e-15, t_eval=at, max_step=0.02
        )
        return np.asarray(found.y)

    orbits = Orbits(lambda state: run(state, None)[:, -1], size)

    def both(start: Array) -> Array:
        if not np.isfinite(start).all():
            return np.full((2, size, PHASES.size), np.nan)
        rows = run(start, PHASES)
        return np.stack([rows, rows])

    return Case(
        name,
        model_of(name, equations),
        force,
        lambda start, _: both(orbits.nearest(start)),
        lambda _: both(np.zeros(size)),
    )


def duffing(name: str, damping: float, cubic: float, amplitude: float) -> Case:
    """A hardening spring, on whichever branch a solver ends."""

    def rates(t: float, s: Array) -> tuple[float, float]:
        q, v = s
        return v, amplitude * cos(2 * pi * t) - damping * v - 20.0 * q - cubic * q * q * q

    equation = f"one*ddot(q) + {damping}*dot(q) + 20*q + {cubic}*q**3 - u"
    return integrated(name, {"q": equation}, rates, 2, motion(0.0, [amplitude]))


def relaxation(strength: float) -> Case:
    """Van der Pol's oscillator, driven near its own frequency."""

    def rates(t: float, s: Array) -> tuple[float, float]:
        q, v = s
        return v, 60.0 * cos(2 * pi * t) + strength * (1 - q * q) * v - 40.0 * q

    equation = f"one*ddot(q) - {strength}*(1 - q**2)*dot(q) + 40*q - u"
    return integrated("relaxation", {"q": equation}, rates, 2, motion(0.0, [60.0]))


def steep_friction(slope: float) -> Case:
    """Friction by a steep function of the velocity: the mass nearly sticks."""

    def rates(t: float, s: Array) -> tuple[float, float]:
        q, v = s
        return v, 8.0 * cos(2 * pi * t) - 0.5 * v - 60.0 * q - 4.0 * tanh(slope * v)

    equation = f"one*ddot(q) + 0.5*dot(q) + 60*q + 4*tanh({slope}*dot(q)) - u"
    return integrated(f"friction tanh({slope:g} v)", {"q": equation}, rates, 2, motion(0.0, [8.0]))


def oleo() -> Case:
    """Gas that is compressed, and an orifice."""

    def rates(t: float, s: Array) -> tuple[float, float]:
        q, v = s
        gas = 20.0 * (1.0 / (1.0 - q) ** 1.2 - 1.0)
        return v, 4.0 + 8.0 * cos(2 * pi * t) - gas - 3.0 * v * abs(v)

    equation = "one*ddot(q) + 20*(1/(1 - q)**1.2 - 1) + 3*dot(q)*abs(dot(q)) - u"
    return integrated("gas and orifice", {"q": equation}, rates, 2, motion(4.0, [8.0]))


def warm_oleo() -> Case:
    """The same with gas that warms and loses heat to its wall."""

    def rates(t: float, s: Array) -> tuple[float, float, float]:
        q, v, w = s
        gas = 20.0 * ((1.0 + w) / (1.0 - q) - 1.0)
        push = 4.0 + 8.0 * cos(2 * pi * t) - gas - 3.0 * v * abs(v)
        return v, push, 0.4 * (1.0 + w) * v / (1.0 - q) - 2.0 * w

    equations = {
        "q": "one*ddot(q) + 20*((1 + w)/(1 - q) - 1) + 3*dot(q)*abs(dot(q)) - u",
        "w": "dot(w) - 0.4*(1 + w)*dot(q)/(1 - q) + 2*w",
    }
    return integrated("gas that warms", equations, rates, 3, motion(4.0, [8.0]))


# -- all of them ---------------------------------------------------------------------------------

PROBLEMS: tuple[Callable[[], Case], ...] = (
    lambda: lag(1e-6, 50.0),
    lambda: end_stop(1e8),
    lambda: oscillator("harmonic 200", 0.5, 100.0, single(200, 300.0)),
    lambda: duffing("Duffing, strong", 0.4, 300.0, 8.0),
    lambda: oscillator("resonance, damping ratio 1e-4", 2e-4 * 6.28, 6.28**2, motion(0.0, [1.0])),
    lambda: lag(1e-3, 500.0),
    lambda: lag(1e-2, 50.0),
    lambda: oscillator("harmonic 50", 0.5, 100.0, single(50, 30.0)),
    lambda: oscillator("harmonic 100", 0.5, 100.0, single(100, 100.0)),
    lambda: oscillator("third harmonic at resonance", 0.02, 355.0, motion(0.0, [1.0, 0.0, 0.1])),
    lambda: oscillator(
        "pulse", 0.5, 100.0, motion(0.0, [1.0]), "40/(1 + ((u - 0.3)/0.002)**2)",
        lambda u: 40 / (1 + ((u - 0.3) / 0.002) ** 2),
    ),
    lambda: oscillator(
        "steep function of the input", 0.5, 100.0, motion(0.0, [1.0]), "40*tanh(200*u)",
        lambda u: 40 * np.tanh(200 * u),
    ),
    lambda: end_stop(1e4),
    lambda: end_stop(1e11),
    dry_friction,
    lambda: duffing("Duffing, lightly damped", 0.05, 100.0, 1.0),
    lambda: relaxation(15.0),
    lambda: steep_friction(300.0),
    oleo,
    warm_oleo,
)  # fmt: skip


@dataclass(frozen=True)
class Solve:
    """What a solver said, and what is true.

    Parameters
    ----------
    ok, motion : bool
        Whether its status says that the motion may be used; whether there is one.
    tolerance, estimate, error : float
        Asked for, said and true, over the swing.
    """

    ok: bool
    motion: bool
    tolerance: float
    estimate: float
    error: float

    @property
    def silent(self) -> bool:
        """Whether it is wrong and does not say so."""
        return self.ok and not self.error <= FACTOR * np.fmax(self.tolerance, self.estimate)


def error_of(rows: Array, bounds: Array) -> float:
    """Largest distance of states ``(D, N)`` from between bounds ``(2, D, N)``, over the swing."""
    away = np.maximum(np.maximum(bounds[0] - rows, rows - bounds[1]), 0.0)
    swing = np.ptp(bounds[0], axis=1)
    return float((away.max(axis=1) / swing).max())


def solve_periodic(case: Case, method: str) -> Solve:
    """One of the ways to a periodic motion, as a user calls it."""
    tolerance = OF_LIBRARY if method == "library" else TOLERANCE
    plan = RunPlan("a", 1.0, {"u": case.force})
    found = periodic_orbit(
        case.model, plan, None, method, tolerance=tolerance, backend="numpy", jobs=1
    )
    orbit = found.orbits[0]
    if not orbit.status.solved:
        return Solve(False, False, tolerance, np.nan, np.nan)
    rows = found.rows(PHASES)[0][state_rows(found.kernels.derived.orders)]
    delay = FACTOR * float(np.fmax(tolerance, orbit.error))
    first = found.rows(np.zeros(1))[0][state_rows(found.kernels.derived.orders)]
    bounds = case.periodic(first[:, 0], min(delay, 0.01))
    return Solve(orbit.status.ok, True, tolerance, orbit.error, error_of(rows, bounds))


def solve_transient(case: Case) -> Solve:
    """From rest, through one period of the same input."""
    times = np.linspace(0.0, 1.0, 1025)
    samples = {"u": case.force.evaluate(times, 1.0), "y": np.zeros(times.size)}
    exact = Harmonics(case.force.orders, case.force.coefficients, case.force.variances)
    record = Record(
        "a", "", "fit", "transient", np.nan, np.nan, 0, times, samples, {},
        dict.fromkeys(samples, 0.0), smoothed={"u": exact},
    )  # fmt: skip
    run = TransientRun(case.model, kernels(case.model, backend="numpy"), record, 128, "radau3")
    status = run.set_anchor(run.base_constants())
    if not status.solved or run.anchor is None:
        return Solve(False, False, KNOWN, np.nan, np.nan)
    estimate = motion_error(run).error
    plan = run.collocation.plan(PHASES, run.steps, initial=True)
    x = run.anchor.x[None, :, :, None]
    orders = run.kernels.derived.orders
    rows = run.scheme.sample(x, plan, run.boundary.step(run.steps))[0, :, 0][state_rows(orders)]
    delay = FACTOR * float(np.fmax(KNOWN, estimate))
    ok = bool(estimate <= KNOWN * 1e3)
    return Solve(ok, True, KNOWN, estimate, error_of(rows, case.transient(min(delay, 0.01))))


def figures(fraction: float = 1.0, say: Callable[[str], object] = print) -> dict[str, float]:
    """Count the solves that are silently wrong.

    Parameters
    ----------
    fraction : float
        Part of the problems that is solved, from the first on.
    say : callable
        Told each solve.

    Returns
    -------
    dict of str to float
        ``silently_wrong``, ``solves``, ``solves_ok``, ``said_unsure``, ``solves_failed``,
        ``worst_silent_error`` (over the swing; of those that say they may be used, the largest
        error over the larger of tolerance and estimate is ``worst_error_ratio``).
    """
    done: list[Solve] = []
    for make in PROBLEMS[: max(1, round(fraction * len(PROBLEMS)))]:
        case = make()
        for method in (*SOLVERS, "transient"):
            begin = time.perf_counter()
            one = solve_transient(case) if method == "transient" else solve_periodic(case, method)
            done.append(one)
            word = "ok" if one.ok else ("unsure" if one.motion else "failed")
            say(
                f"{case.name:30} {method:15} {word:7} estimate {one.estimate:8.1e}"
                f"  error {one.error:8.1e}{'  SILENT' if one.silent else ''}"
                f"  {time.perf_counter() - begin:.1f} s"
            )
    silent = [one.error for one in done if one.silent]
    ratios = [one.error / np.fmax(one.tolerance, one.estimate) for one in done if one.ok]
    return {
        "silently_wrong": float(len(silent)),
        "solves": float(len(done)),
        "solves_ok": float(sum(one.ok for one in done)),
        "said_unsure": float(sum(one.motion and not one.ok for one in done)),
        "solves_failed": float(sum(not one.motion for one in done)),
        "worst_silent_error": float(np.max(silent, initial=0.0)),
        "worst_error_ratio": float(np.max(ratios, initial=0.0)),
    }


if __name__ == "__main__":
    print(figures())
