r"""
Parameters of chaotic records
=============================

A chaotic motion forgets its initial state. After some Lyapunov times the samples are too sensitive
to the initial state and the parameters to be fitted directly. Multiple shooting gives each short
piece of the record its own initial state and requires continuity of the result only (Bock 1987,
Baake et al. 1992; Verbeek 1993, section 4.4). This page applies it to the systems of Lorenz and
Rössler.
"""

# %%
# Samples of the Lorenz system, 20 units of time - eighteen Lyapunov times - with noise of 5 % of
# the spread of each component, made by an integrator of SciPy's.

# sphinx_gallery_thumbnail_number = 2
import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

import bayesoleo
from bayesoleo import plots
from bayesoleo.estimation import multiple_shooting
from bayesoleo.gallery import Study
from bayesoleo.prediction import transient_record


def lorenz(_, state, sigma=10.0, rho=28.0, beta=8 / 3):
    """Rates of the Lorenz system."""
    x, y, z = state
    return [sigma * (y - x), x * (rho - z) - y, x * y - beta * z]


def solved(rates, start, time, precision, *values):
    """States at times, shape (3, n)."""
    options = {"method": "DOP853", "rtol": precision, "atol": precision, "args": values}
    return solve_ivp(rates, (0, time[-1]), start, t_eval=time, **options).y


time = 0.05 * np.arange(401)
# The transient from a start off the attractor takes less than 60 units of time.
motion = solved(lorenz, [1.0, 1.0, 1.0], np.concatenate([[0.0], 60 + time]), 1e-11)[:, 1:]
noise = 0.05 * motion.std(axis=1, keepdims=True)
noisy = motion + noise * np.random.default_rng(7).standard_normal(motion.shape)
record = transient_record("lorenz", time, dict(zip("xyz", noisy, strict=True)))

# %%
# *Single* shooting fits the parameters and one initial state. Even with all other values true, the
# misfit has a single minimum only for a short record. Over the whole record it is a comb, as high
# as for two unrelated motions, and the minimum at the truth is too narrow to be found.

rhos = np.linspace(24.0, 32.0, 241)
ways = [solved(lorenz, motion[:, 0], time, 1e-6, 10.0, rho) for rho in rhos]
misfit = np.sum((np.array(ways) - motion) ** 2, axis=1) / motion.var(axis=1).sum()
figure, panels = plt.subplots(1, 3, figsize=(10, 2.9), layout="constrained")
for axes, length in zip(panels, (1.0, 5.0, 20.0), strict=True):
    axes.plot(rhos, misfit[:, time <= length].mean(axis=1), color="#0072b2", lw=1.2)
    axes.axvline(28.0, color="#d55e00", lw=0.9)
    axes.set(title=f"record of {length:g} s", xlabel="ρ", ylim=(0.0, None))
panels[0].set_ylabel("misfit over variance")
plt.show()

# %%
# Multiple shooting with the same record. The parameters start 20 % off, the states at the smoothed
# samples.

model = bayesoleo.system("lorenz")
found = multiple_shooting(model, [record], start=[12.0, 22.4, 3.2], backend="numpy")
print(found)

# %%
# One component suffices if it determines the others. From ``x`` alone the parameters are found too,
# and with them the components that were not measured. These start at their declared guess.

record_of_x = transient_record("lorenz", time, {"x": noisy[0]})
alone = multiple_shooting(model, [record_of_x], start=[12.0, 22.4, 3.2], backend="numpy")
print(alone)
truth = {name: (time, row) for name, row in zip("xyz", motion, strict=True)}
hidden = plots.trajectory(alone.trajectories[0], truth=truth)

# %%
# Fifty records of each system, each with other noise and another start, with all three states or
# one component measured. The errors, in units of the standard error of each fit, stay below three
# and scatter as expected. The lower panel has the same records by single shooting with as many
# iterations; it does not reach the truth.

study = Study("chaos", slow=True, needs=("chaos", "chaos_figures"))
chaos, figures = study.helper("chaos"), study.helper("chaos_figures")
table = study.run(lambda: chaos.every_spread())
study.text("seeds", lambda: chaos.print_spread(table))
spread = study.figure("spread", lambda: figures.draw_spread(table))
