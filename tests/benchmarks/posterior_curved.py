"""Curved posteriors and one of 25 dimensions: effective draws a CPU second against NUTS.

Our draws count from the Laplace mixture to the last kept one, theirs from the same modes with the
adaptation of step size and masses; compiling is left out, and of each peer the best of its
settings is taken. ``z`` is the largest difference of a mean from its exact value, in standard
errors, and of a standard deviation likewise.

These densities are formulas, which a peer compiles into its loop: effective draws a second say how
fast the loop is. Where a density solves a campaign, the loop is nothing beside it, and effective
draws a call count. A peer's call has the gradient too. Of an oleo's campaign of 14 runs it takes
five times as long as a density, and 25 times as long as one of the 40 that an ensemble asks for
together (11, 2.0 and 0.43 ms).

``<case>_nuts`` is our no-U-turn sampler, by nutpie with gradients of the problem's sensitivities,
in Python: its calls count, its seconds do not compare with formulas that are compiled.
"""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from posterior_curved_cases import CASES, Case

from bayesoleo.posterior import sample
from bayesoleo.posterior._diagnostics import effective_size

Array = NDArray[np.float64]
WANTED, TUNE, DRAWS, CHAINS = 4000, 500, 2000, 2
#: Gradients of our own no-U-turn sampler at most.
MOST_GRADIENTS = 60_000


def z_of(case: Case, draws: Array, size: Array) -> float:
    """Largest error of means and standard deviations in standard errors of so many draws."""
    flat = draws.reshape(-1, draws.shape[-1])[:, : case.mean.size]
    size = size[: case.mean.size]
    mean = np.abs(flat.mean(axis=0) - case.mean) / case.sd * np.sqrt(size)
    fourth = np.mean(((flat - case.mean) / case.sd) ** 4, axis=0)
    # An effective size of the squares is not known; a spread's error is that of independent draws.
    sd = np.abs(flat.std(axis=0) / case.sd - 1) / np.sqrt((fourth - 1) / 4 / size)
    return float(max(mean.max(), sd.max()))


def described(case: Case, draws: Array, used: float, calls: int) -> dict[str, float]:
    """Effective draws a CPU second and a call of the density, and errors."""
    size = effective_size(draws)
    return {
        "ess": float(size.min()),
        "ess_per_cpu_s": float(size.min()) / used,
        "ess_per_call": float(size.min()) / calls,
        "z": z_of(case, draws, size),
    }


def ours(case: Case, sampler: str = "ensemble") -> dict[str, float]:
    """The package's sampler; ``nuts`` ends after :data:`MOST_GRADIENTS`, converged or not."""
    given = {"progress": False, "sampler": sampler}
    sample(case.density, case.mixture, seed=2, quick=True, **given)  # modules are imported
    if sampler == "nuts":
        given |= {"max_evaluations": MOST_GRADIENTS, "climbs": 0}
    used = time.process_time()
    found = sample(case.density, case.mixture, effective_size=WANTED, seed=1, **given)
    used = time.process_time() - used
    return (
        described(case, found.draws, used, found.evaluations)
        | {
            "evaluations": found.evaluations,
            "reached": int(found.reached),
            "cpu_s": used,
        }
        | ({} if found.diverging is None else {"divergences": found.divergences})
    )


def starts(case: Case, back: Callable[[Array], Array]) -> Array:
    """Draws of the Laplace mixture, one for each chain, in a peer's coordinates."""
    phi = case.mixture.sample(np.random.default_rng(0), CHAINS)
    return np.asarray(back(case.density.natural(phi)))


def with_numpyro(case: Case, form: str, dense: bool) -> tuple[Array, float, int]:
    """Natural draws (chains, draws, d), CPU time, and calls of the gradient."""
    import jax
    from numpyro.infer import MCMC, NUTS

    jax.config.update("jax_enable_x64", True)
    height, natural, back = case.forms[form]
    kernel = NUTS(potential_fn=lambda x: -height(x), dense_mass=dense)
    chains = MCMC(
        kernel, num_warmup=TUNE, num_samples=DRAWS, num_chains=CHAINS, chain_method="sequential",
        progress_bar=False,
    )  # fmt: skip
    first = jax.numpy.asarray(starts(case, back))
    for seed in (0, 1):  # the first one compiles
        used = time.process_time()
        said = {"extra_fields": ("num_steps",)}
        chains.warmup(jax.random.PRNGKey(seed), init_params=first, collect_warmup=True, **said)
        calls = int(np.sum(chains.get_extra_fields()["num_steps"]))
        chains.run(jax.random.PRNGKey(seed), **said)
        draws = np.asarray(chains.get_samples(group_by_chain=True))
        used = time.process_time() - used
    calls += int(np.sum(chains.get_extra_fields()["num_steps"]))
    return np.stack([natural(one) for one in draws]), used, calls


def with_blackjax(case: Case, form: str, dense: bool) -> tuple[Array, float, int]:
    """Natural draws (chains, draws, d), CPU time, and calls of the gradient."""
    import blackjax
    import jax

    jax.config.update("jax_enable_x64", True)
    height, natural, back = case.forms[form]

    @jax.jit
    def chain(key, first):
        tuning, drawing = jax.random.split(key)
        adaptation = blackjax.window_adaptation(
            blackjax.nuts, height, is_mass_matrix_diagonal=not dense
        )
        (state, tuned), warm = adaptation.run(tuning, first, TUNE)
        step = blackjax.nuts(height, **tuned).step

        def one(state, key):
            state, told = step(key, state)
            return state, (state.position, told.num_integration_steps)

        draws, steps = jax.lax.scan(one, state, jax.random.split(drawing, DRAWS))[1]
        return draws, steps.sum() + warm.info.num_integration_steps.sum()

    first = jax.numpy.asarray(starts(case, back))
    jax.block_until_ready(chain(jax.random.PRNGKey(9), first[0]))  # compiles
    used = time.process_time()
    found = jax.block_until_ready([chain(jax.random.PRNGKey(k), x) for k, x in enumerate(first)])
    used = time.process_time() - used
    draws = np.stack([natural(np.asarray(one)) for one, _ in found])
    return draws, used, sum(int(steps) for _, steps in found)


PEERS = {"numpyro": with_numpyro, "blackjax": with_blackjax}


def peers(case: Case) -> Iterator[tuple[str, dict[str, float]]]:
    """Each peer that is installed, in each form; with dense masses where these are few."""
    for name, run in PEERS.items():
        if importlib.util.find_spec(name) is None:
            continue
        for form in case.forms:
            draws, used, calls = run(case, form, len(case.density.names) < 10)
            yield f"{name}_{form}", described(case, draws, used, calls)


def figures(name: str) -> dict[str, float]:
    """One case; ``nuts_ratio_<case>`` is ours over the best of the peers in a CPU second,
    ``nuts_call_ratio_<case>`` in a call of the density."""
    case = CASES[name]()
    mine = ours(case)
    table = {f"{name}_{key}": value for key, value in mine.items()}
    if importlib.util.find_spec("nutpie") is not None:
        table |= {f"{name}_nuts_{key}": value for key, value in ours(case, "nuts").items()}
    others = dict(peers(case))
    for peer, found in others.items():
        table |= {f"{name}_{peer}_{key}": value for key, value in found.items()}
    for ratio, by in (("nuts_ratio", "ess_per_cpu_s"), ("nuts_call_ratio", "ess_per_call")):
        if others:
            table[f"{ratio}_{name}"] = mine[by] / max(found[by] for found in others.values())
    return table


def curved_figures() -> dict[str, float]:
    """All cases."""
    table: dict[str, float] = {}
    for name in CASES:
        found = figures(name)
        print(f"  {name}: {found}", file=sys.stderr, flush=True)
        table |= found
    return table
