"""Other samplers: nutpie with our gradients, and what pyPESTO and lmfit say of their emcee."""

from __future__ import annotations

import logging
import time

import numpy as np
from numpy.typing import NDArray
from posterior_cases import Case, gas_spring_case, oleo_case

from bayesoleo.posterior._diagnostics import autocorrelation_time, effective_size
from bayesoleo.posterior._gradient import Gradient

Array = NDArray[np.float64]

#: Steps of the peers' ensembles on the gas spring, and walkers.
STEPS, WALKERS = 1500, 24


class Whitened:
    """The package's gradient in coordinates whitened by the Laplace approximation, which a sampler
    may know before it begins.

    Parameters
    ----------
    case : Case
    """

    def __init__(self, case: Case) -> None:
        self.centre = case.mixture.centres[0]
        self.factor = np.linalg.cholesky(case.mixture.covariances[0])
        scale = np.sqrt(np.sum(self.factor**2, axis=1))
        self.gradient = Gradient(case.density.for_thread(), scale)  # chains have threads of theirs
        self.calls = 0

    def __call__(self, z: Array) -> tuple[float, Array]:
        self.calls += 1
        value, gradient = self.gradient(self.centre + self.factor @ z)
        return value, self.factor.T @ gradient  # minus infinity is a divergence


def gradient_error(case: Case) -> float:
    """Largest difference of the gradient from central differences of the density, whitened."""
    at, z = Whitened(case), np.full(case.dimension, 0.3)
    _, exact = at(z)
    rows = z + 1e-4 * np.concatenate([np.eye(z.size), -np.eye(z.size)])
    values, _ = case.density(at.centre + rows @ at.factor.T)
    return float(np.max(np.abs((values[: z.size] - values[z.size :]) / 2e-4 - exact)))


def nutpie_on_oleo(chains: int = 2, tune: int = 150, draws: int = 250) -> dict[str, float]:
    """No-U-turn sampling of the campaign."""
    try:
        import nutpie
        from nutpie.compiled_pyfunc import from_pyfunc
    except ImportError:
        return {}
    case = oleo_case()
    at = Whitened(case)
    model = from_pyfunc(
        case.dimension,
        lambda: at,
        lambda *_: lambda z: {"z": z},
        [np.dtype(float)],
        [(case.dimension,)],
        ["z"],
    )
    wall, used = time.perf_counter(), time.process_time()
    tree = nutpie.sample(
        model, draws=draws, tune=tune, chains=chains, cores=chains, seed=1, progress_bar=False
    )
    wall, used = time.perf_counter() - wall, time.process_time() - used
    size = float(effective_size(tree["posterior"]["z"].values).min())
    return {
        "nutpie_ess_per_s": size / wall,
        "nutpie_ess_per_s_cpu": size / (used / chains),
        "nutpie_ess_per_gradient": size / at.calls,
        "nutpie_gradients": at.calls,
        "gradient_error": gradient_error(case),
    }


def lmfit_on_spring(case: Case) -> dict[str, float]:
    """``Minimizer.emcee`` with its default moves; it reports a time per parameter."""
    try:
        import lmfit
    except ImportError:
        return {}
    names = ("theta", "log_variance")
    parameters = lmfit.Parameters()
    for name, value, low, high in zip(
        names, case.mixture.centres[0], (0.5, -9.0), (2.0, 5.0), strict=True
    ):
        parameters.add(name, value=float(value), min=low, max=high)

    def height(p: lmfit.Parameters) -> float:
        return float(case.density(np.array([[p[name].value for name in names]]))[0][0])

    start = case.mixture.sample(np.random.default_rng(1), WALKERS)
    found = lmfit.Minimizer(height, parameters).emcee(
        steps=STEPS, nwalkers=WALKERS, pos=start, seed=1, progress=False,
        float_behavior="posterior", is_weighted=True,
    )  # fmt: skip
    draws = np.asarray(found.chain).swapaxes(0, 1)  # steps first
    told = np.max(found.acor) if getattr(found, "acor", None) is not None else np.nan
    return {
        "lmfit_tau": float(told),
        "lmfit_ess": len(found.flatchain) / float(told),
        "lmfit_tau_true": float(autocorrelation_time(draws).max()),
        "lmfit_ess_true": float(effective_size(draws).min()),
    }


def pypesto_on_spring(case: Case) -> dict[str, float]:
    """``EmceeSampler``; it reports the effective size of the walkers laid end to end."""
    try:
        import pypesto
        import pypesto.sample as ps
    except ImportError:
        return {}
    logging.getLogger("pypesto").setLevel(logging.ERROR)
    problem = pypesto.Problem(
        pypesto.Objective(fun=lambda x: -float(case.density(np.asarray(x)[None])[0][0])),
        lb=[0.5, -9.0],
        ub=[2.0, 5.0],
    )
    sampler = ps.EmceeSampler(nwalkers=WALKERS, sampler_args={}, run_args={"progress": False})
    np.random.seed(1)  # noqa: NPY002  it takes no other
    # Several starting points are more than its version 0.7 can read: a ball about the mode.
    result = ps.sample(problem, STEPS, sampler, x0=case.mixture.centres[0], filename=None)
    ps.geweke_test(result)
    told = ps.effective_sample_size(result)
    draws = sampler.sampler.get_chain().swapaxes(0, 1)
    return {
        "pypesto_tau": float(result.sample_result.auto_correlation),
        "pypesto_ess": float(told),
        "pypesto_tau_true": float(autocorrelation_time(draws).max()),
        "pypesto_ess_true": float(effective_size(draws).min()),
    }


def peers_figures() -> dict[str, float]:
    """All that are installed."""
    case = gas_spring_case(0.1)
    return nutpie_on_oleo() | lmfit_on_spring(case) | pypesto_on_spring(case)
