r"""The no-U-turn sampler, by nutpie, with gradients of the problem's own.

Chains move in coordinates whitened by the heaviest mode of the start's mixture, so that step size
and masses have little to learn. Each chain has a thread and a copy of the problem: solves start
from the frozen anchors, and the draws depend on the seed alone, not on the threads. The stopping
rule is that of the ensembles, applied after the same fixed numbers of draws; what a chain drew
beyond is dropped.

A chain does not jump between modes that are apart. Where the start has several, and a chain has not
been to one of them, their weights are not known, and the result says so.

References
----------
Hoffman and Gelman (2014), "The No-U-Turn Sampler", *Journal of Machine Learning Research* 15.
Betancourt (2017), "A conceptual introduction to Hamiltonian Monte Carlo", section 6.2 (regions of
high curvature).
"""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import numpy as np

from bayesoleo._parallel import available_cores, thread_limit
from bayesoleo._storage.files import only_writer
from bayesoleo._storage.resume import Arrays, Slots
from bayesoleo._types import Array, Bool, Flags, Float, Int, Integers
from bayesoleo.errors import InputError, import_extra, number_of
from bayesoleo.posterior._diagnostics import Samples
from bayesoleo.posterior._gradient import Differentiable, Gradient, gradient_of
from bayesoleo.posterior._log_density import Density
from bayesoleo.posterior._mixture import Mixture
from bayesoleo.posterior._stopping import (
    ProgressBar,
    Quality,
    Schedule,
    decisions,
    quality_of,
    sizes_of_every,
    stride_of,
)

#: Draws of each chain by which step size and masses are adapted, in full and in quick runs.
TUNE, QUICK_TUNE = 300, 150
#: Gradients of each chain that a quick run has at least: fewer would end while it adapts.
QUICK_GRADIENTS = 2_000
#: Draws of a chain at most.
MOST_DRAWS = 100_000
#: Points of the mixture that are tried for a chain's start.
TRIES = 100
#: Seconds between two looks at the chains.
POLL = 0.05
#: Seconds without a call after which nutpie is asked whether a chain has failed.
SILENCE = 60.0
#: Name of the one quantity that nutpie stores.
_WHITE = "z"
_FOREIGN = "this folder holds draws of another problem, seed or setting"


@dataclass(frozen=True)
class Trace:
    """What the chains did.

    Parameters
    ----------
    coords : ndarray, shape (chains, draws, d)
        Kept draws in coordinates without bounds.
    diverging : ndarray of bool, shape (chains, draws)
        Whether the trajectory of a draw diverged.
    steps : ndarray of int, shape (chains, draws)
        Gradients that a draw took.
    accept : ndarray, shape (chains, draws)
        Mean acceptance along its trajectory.
    first : ndarray, shape (chains, d)
        Where the chains started.
    warm_up : int
        Evaluations before the first kept draw.
    failures : dict of str to int
        Points of density zero by reason, warm-up included.
    branch_jumps, kept_jumps : int
        Solutions that left their branch, in all and among the kept draws.
    mixture : Mixture
        From which chains started.
    """

    coords: Float[Array, "chains draws coordinates"]
    diverging: Bool[Flags, "chains draws"]
    steps: Int[Integers, "chains draws"]
    accept: Float[Array, "chains draws"]
    first: Float[Array, "chains coordinates"]
    warm_up: int
    failures: dict[str, int]
    branch_jumps: int
    kept_jumps: int
    mixture: Mixture

    @property
    def spent(self) -> int:
        """Evaluations in all, of the search for modes too."""
        return self.warm_up + int(self.steps.sum())

    @property
    def quality(self) -> Quality:
        """Diagnostics; each chain is an ensemble of one."""
        return quality_of(self.coords, np.arange(len(self.coords)))

    def arrays(self) -> Arrays:
        """As named arrays."""
        about = {
            "warm_up": self.warm_up,
            "failures": self.failures,
            "jumps": [self.branch_jumps, self.kept_jumps],
        }
        return {
            "coords": self.coords,
            "diverging": self.diverging,
            "steps": self.steps,
            "accept": self.accept,
            "first": self.first,
            "centres": self.mixture.centres,
            "covariances": self.mixture.covariances,
            "log_weights": self.mixture.log_weights,
            "degrees": np.asarray(self.mixture.degrees),
            "about": np.frombuffer(json.dumps(about).encode(), dtype=np.uint8),
        }

    @classmethod
    def of(cls, arrays: Arrays) -> Trace:
        """The trace of :meth:`arrays`."""
        about = json.loads(bytes(arrays["about"]).decode())
        own = ("coords", "diverging", "steps", "accept", "first")
        mixture = Mixture(
            arrays["centres"], arrays["covariances"], arrays["log_weights"], arrays["degrees"]
        )
        kept = {name: arrays[name] for name in own}
        return cls(**kept, mixture=mixture, warm_up=about["warm_up"], failures=about["failures"],
                   branch_jumps=about["jumps"][0], kept_jumps=about["jumps"][1])  # fmt: skip


@dataclass
class _Chain:
    """One chain's gradient, where it began, and what it met by each draw."""

    gradient: Gradient | Differentiable
    first: Array | None = None
    drawn: list[Array] = field(default_factory=list)
    failures: list[Counter[str]] = field(default_factory=list)
    jumps: list[int] = field(default_factory=list)
    spent: list[int] = field(default_factory=list)
    calls: int = 0
    computing: bool = False

    def __call__(self, phi: Array) -> tuple[float, Array]:
        self.calls += 1
        if isinstance(self.gradient, Gradient):
            return self.gradient(phi)
        return self.gradient.with_gradient(phi)

    def keep(self, z: Array) -> None:
        """Note a draw, and what has failed until then."""
        self.drawn.append(np.array(z))
        self.spent.append(self.calls)
        of_campaign = isinstance(self.gradient, Gradient)
        known = cast(Gradient, self.gradient).failures if of_campaign else Counter[str]()
        if not self.failures or self.failures[-1] != known:
            known = Counter(known)
        else:
            known = self.failures[-1]
        self.failures.append(known)
        self.jumps.append(cast(Gradient, self.gradient).density.branch_jumps if of_campaign else 0)


class _Chains:
    """The chains, each in a thread of its own, of which few compute at a time.

    nutpie calls :meth:`start`, :meth:`height` and :meth:`keep` in the chain's thread.
    """

    def __init__(self, log_density: Density, mixture: Mixture, jobs: int) -> None:
        heaviest = int(np.argmax(mixture.log_weights))
        self.centre = mixture.centres[heaviest]
        self.factor = np.linalg.cholesky(mixture.covariances[heaviest])
        self.log_density, self.mixture = log_density, mixture
        self.scale = np.sqrt(np.sum(self.factor**2, axis=1))
        self.error: BaseException | None = None
        self._gate, self._lock = threading.Semaphore(jobs), threading.Lock()
        self._by_thread: dict[int, _Chain] = {}
        self._seen, self._since = list[int](), time.monotonic()
        gradient_of(log_density, self.scale)  # refused here, not in a thread

    @property
    def all(self) -> list[_Chain]:
        """Those that have begun."""
        with self._lock:
            return list(self._by_thread.values())

    def phi(self, z: Array) -> Array:
        """Coordinates without bounds, shape (..., d), from whitened ones."""
        return np.asarray(self.centre + z @ self.factor.T)

    def _here(self) -> _Chain:
        """The chain of this thread."""
        own = threading.get_ident()
        with self._lock:
            if own not in self._by_thread:
                self._by_thread[own] = _Chain(gradient_of(self.log_density, self.scale))
            return self._by_thread[own]

    def start(self, seed: int) -> Array:
        """A draw of the mixture with a density, whitened."""
        rng = np.random.default_rng(seed)
        for _ in range(TRIES):
            phi = self.mixture.sample(rng, 1)[0]
            z = np.linalg.solve(self.factor, phi - self.centre)
            value, _ = self.height(z)
            if np.isfinite(value) or self.error is not None:
                self._here().first = phi
                return np.asarray(z)
        self.error = InputError(
            f"no start among {TRIES} has a density and a gradient that are finite",
            hint="check the start and the priors",
        )
        return np.zeros_like(self.centre)

    def height(self, z: Array) -> tuple[float, Array]:
        """Log density and gradient over whitened coordinates; an error ends all chains."""
        if self.error is None:
            try:
                chain = self._here()
                chain.computing = True
                with self._gate:
                    value, gradient = chain(self.phi(z))
                chain.computing = False
                return value, self.factor.T @ gradient
            except BaseException as error:  # nutpie would end the process
                self.error = error
        return -np.inf, np.zeros_like(z)

    def check(self, handle: Any) -> None:
        """Raise what a chain raised, also where nutpie itself has failed.

        Draws are noted here, so that nutpie is asked only where chains make no progress; its
        ``is_finished`` raises a ``TimeoutError`` while they run (0.16).
        """
        if self.error is not None:
            raise self.error
        calls = [chain.calls for chain in self.all]
        now = time.monotonic()
        if calls != self._seen or any(chain.computing for chain in self.all):
            self._seen, self._since = calls, now
        elif now - self._since > SILENCE:
            self._since = now
            with suppress(TimeoutError):
                handle.wait(timeout=POLL)

    def keep(self, z: Array) -> dict[str, Array]:
        """Note a draw."""
        self._here().keep(z)
        return {_WHITE: np.asarray(z)}


def draw(
    log_density: Density,
    mixture: Mixture,
    schedule: Schedule,
    *,
    chains: int,
    seed: int,
    tune: int,
    target_accept: float,
    bar: ProgressBar,
) -> Trace:
    """Draw until the stopping rule is met or the gradients are used up.

    Parameters
    ----------
    log_density : Density
        With a gradient: a :class:`~bayesoleo.posterior.LogDensity`, or one with a method
        ``with_gradient(phi)``.
    mixture : Mixture
        From which chains start; its heaviest component whitens the coordinates.
    schedule : Schedule
    chains, seed, tune : int
    target_accept : float
    bar : ProgressBar

    Raises
    ------
    InputError
        If the density has no gradient, no start is found, or the gradients are used up before a
        draw is kept.
    MissingExtraError
        If nutpie is not installed.
    """
    nutpie = import_extra("nutpie", "nuts")
    jobs = min(getattr(log_density, "jobs", None) or available_cores(), thread_limit(), chains)
    own = _Chains(log_density, mixture, jobs)
    size = mixture.dimension
    model = import_module("nutpie.compiled_pyfunc").from_pyfunc(
        size,
        lambda: own.height,
        lambda *_: own.keep,
        [np.dtype(float)],
        [(size,)],
        [_WHITE],
        make_initial_point_fn=own.start,
    )
    handle = nutpie.sample(
        model, draws=MOST_DRAWS, tune=tune, chains=chains, cores=chains, seed=seed,
        target_accept=target_accept, progress_bar=False, blocking=False, return_raw_trace=True,
    )  # fmt: skip
    with _ended(handle):
        return _until_good(handle, own, schedule, chains, tune, bar)


@contextmanager
def _ended(handle: Any) -> Iterator[None]:
    """The chains end with the block: the interpreter must not end before them."""
    try:
        yield
    finally:
        # What ended the block says more than a sampler that is ended twice; nutpie's own kind of
        # panic is no Exception.
        with suppress(BaseException):
            handle.cancel()


def _until_good(
    handle: Any, own: _Chains, schedule: Schedule, chains: int, tune: int, bar: ProgressBar
) -> Trace:
    done, size = 0, 0.0
    while True:
        time.sleep(POLL)
        own.check(handle)
        begun = own.all
        drawn = min(len(chain.jumps) for chain in begun) - tune if len(begun) == chains else -tune
        calls = sum(chain.calls for chain in begun)
        bar.show("warm-up" if drawn <= 0 else "sampling", size, calls)
        following = min(decisions(schedule.least, done)[-1], MOST_DRAWS)
        if not done and _needed(begun, tune + following) > schedule.max_evaluations:
            raise InputError(
                "no draw could be kept within so many evaluations",
                key="max_evaluations",
                value=schedule.max_evaluations,
                hint=f"allow at least {4 * schedule.max_evaluations}",
            )
        # The last draw that was noted may not be stored yet.
        if drawn < following + (following < MOST_DRAWS):
            continue
        done, end = following, tune + following
        coords = np.stack([own.phi(np.array(chain.drawn[tune:end])) for chain in begun])
        quality = quality_of(coords, np.arange(chains))
        size = float(quality.sizes.min())
        spent = sum(chain.spent[end - 1] for chain in begun)
        ahead = spent * decisions(schedule.least, done)[-1] / done
        good = not quality.shortfalls(schedule, chains)
        if good or ahead > schedule.max_evaluations or done == MOST_DRAWS:
            ended = handle.wait() if done == MOST_DRAWS else handle.abort()
            return _read(ended, own, tune, done)


def _needed(begun: list[_Chain], draws: int) -> int:
    """Gradients until each chain has so many draws, or as far as it is: chains that run ahead of
    the others, as threads happen to be given time, do not count for more."""
    return sum(c.spent[draws - 1] if len(c.jumps) >= draws else c.calls for c in begun)


def _read(raw: Any, own: _Chains, tune: int, draws: int) -> Trace:
    """The first kept draws of nutpie's trace."""
    arrow = import_module("pyarrow")
    whole = slice(0, tune + draws)
    kept, stats, began = [], [], []
    for one, more in zip(*raw.get_arrow_trace(), strict=True):
        z = arrow.record_batch(one).column(_WHITE).flatten().to_numpy()
        z = z.reshape(-1, own.centre.size)[whole]
        table = arrow.record_batch(more)
        columns = ("diverging", "n_steps", "mean_tree_accept")
        stats.append([table.column(c).to_numpy(zero_copy_only=False)[whole] for c in columns])
        kept.append(own.phi(z)[tune:])
        # Threads begin in any order; the first draw says whose is which.
        began.append(next(c for c in own.all if np.array_equal(c.drawn[0], z[0])))
    diverging, steps, accept = (np.stack(part) for part in zip(*stats, strict=True))
    last, warm = whole.stop - 1, tune - 1
    jumps = sum(chain.jumps[last] for chain in began)
    return Trace(
        coords=np.stack(kept),
        diverging=diverging[:, tune:].astype(bool),
        steps=steps[:, tune:].astype(np.int64),
        accept=accept[:, tune:],
        first=np.stack([cast(Array, chain.first) for chain in began]),
        warm_up=int(steps[:, :tune].sum()),
        failures=dict(sum((chain.failures[last] for chain in began), start=Counter[str]())),
        branch_jumps=jumps,
        kept_jumps=jumps - sum(chain.jumps[warm] for chain in began),
        mixture=own.mixture,
    )


@contextmanager
def stored(folder: Path | None, fingerprint: str) -> Iterator[Slots]:
    """The place of a complete run, while other processes are kept out.

    Raises
    ------
    ResultsError
        If another process writes there, or the folder holds another run.
    """
    with only_writer(folder):
        yield Slots(folder, fingerprint, name="nuts", foreign=_FOREIGN)


def serves(trace: Trace, schedule: Schedule) -> bool:
    """Whether a run that was stored is what would be drawn again."""
    draws = trace.coords.shape[1]
    ahead = trace.spent * decisions(schedule.least, draws)[-1] / draws
    spent = ahead > schedule.max_evaluations or draws == MOST_DRAWS
    return spent or not trace.quality.shortfalls(schedule, len(trace.coords))


def samples_of(trace: Trace, log_density: Density, schedule: Schedule, *, quick: bool) -> Samples:
    """Draws with their diagnostics.

    Parameters
    ----------
    trace : Trace
    log_density : Density
        Evaluated once more at the draws that are handed on, for the log-likelihood of each run.
    schedule : Schedule
    quick : bool
    """
    quality = trace.quality
    chains, draws, dimension = trace.coords.shape
    every = stride_of(getattr(log_density, "errors", None), quality, chains, draws, quick)
    last = np.arange(draws % every, draws, every) + every - 1
    rows = trace.coords[:, last].reshape(-1, dimension)
    height, by_run = log_density(rows)
    short = quality.shortfalls(schedule, chains, "chains")
    if short:
        most = f"before {schedule.max_evaluations} evaluations"
        short.insert(0, f"stopped {f'after {draws} draws' if draws == MOST_DRAWS else most}")
    short += _modes_apart(trace)
    said = [*short, *_divergences(trace)]
    if not np.isfinite(height).all():
        lost = np.count_nonzero(~np.isfinite(height))
        said.append(f"{lost} draws have no density when evaluated again")
    accepted = float(trace.accept.mean())
    return Samples(
        names=log_density.names,
        runs=log_density.runs,
        draws=log_density.natural(rows).reshape(chains, -1, dimension),
        log_density=height.reshape(chains, -1),
        log_likelihood=by_run.reshape(chains, len(last), -1),
        ensemble=np.arange(chains),
        start=log_density.natural(trace.first),
        mixture=trace.mixture,
        autocorrelation_time=quality.times,
        effective_size=sizes_of_every(quality, every),
        rhat_nested=quality.rhat,
        acceptance={"nuts": accepted, "all": accepted},
        evaluations=trace.spent + len(rows),
        failures=trace.failures,
        reached=not short,
        warning="; ".join(said),
        branch_jumps=trace.branch_jumps,
        jumped_part=min(1.0, trace.kept_jumps / max(int(trace.steps.sum()), 1)),
        sampler="nuts",
        diverging=trace.diverging[:, last],
        divergences=int(trace.diverging.sum()),
    )


def _modes_apart(trace: Trace) -> list[str]:
    """A sentence if some chain has not been to a mode from which chains may start."""
    mixture = trace.mixture
    if len(mixture.centres) < 2:
        return []
    nearest = [np.argmax(mixture.log_components(one), axis=1) for one in trace.coords]
    been = [len(np.unique(one)) for one in nearest]
    if min(been) == len(mixture.centres):
        return []
    return [
        f"a chain has been to {min(been)} of {number_of(len(mixture.centres), 'known mode')}, so"
        " that their weights are not known: the sampler ensemble moves between modes"
    ]


def _divergences(trace: Trace) -> list[str]:
    """What is said of trajectories that diverged."""
    number = int(trace.diverging.sum())
    if not number:
        return []
    return [
        f"{number} of {trace.diverging.size} trajectories diverged: the draws may miss a narrow"
        " region of the posterior; compare with the sampler ensemble, or raise target_accept"
    ]


def with_quick_budget(schedule: Schedule, chains: int) -> Schedule:
    """A quick schedule with gradients enough to adapt."""
    most = max(schedule.max_evaluations, QUICK_GRADIENTS * chains)
    return replace(schedule, max_evaluations=most)
