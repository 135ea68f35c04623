r"""
Parameters of chaotic records
=============================

A chaotic motion forgets its start: what is measured after some Lyapunov times is no usable function
of the initial state and the parameters any more. Multiple shooting gives every short piece of the
record an initial state of its own and asks for continuity of the result only (Bock 1987, Baake et
al. 1992; Verbeek 1993, section 4.4). This page does it for the systems of Lorenz and Rössler.
"""

# %%
# Samples of the Lorenz system, 20 units of time - eighteen Lyapunov times - with noise of 5 % of
# the spread of each component, made by an integrator of SciPy's.

import chaos
import numpy as np
from chaos_figures import draw_landscape, draw_spread
from scipy.integrate import solve_ivp
from stored import Study

import bayesoleo
from bayesoleo import plots
from bayesoleo.estimation import multiple_shooting

attractor = chaos.Attractor.of("lorenz")
record = attractor.record(seed=7)

# %%
# Fitting the initial state and the parameters alone is *single* shooting. Even with all else at its
# true value, the misfit has one minimum only while the record is short. Over the whole record it
# is a comb, at the height of what two unrelated motions differ by, and the minimum at the truth is
# too narrow to be found.

rhos = np.linspace(24.0, 32.0, 241)
misfit = np.empty((rhos.size, attractor.time.size))
for row, rho in zip(misfit, rhos, strict=True):
    way = solve_ivp(
        chaos.lorenz, (0, 20), attractor.motion[:, 0], args=(10.0, rho), method="DOP853",
        t_eval=attractor.time, rtol=1e-6, atol=1e-6,
    )  # fmt: skip
    row[:] = np.sum((way.y - attractor.motion) ** 2, axis=0)
total = attractor.motion.var(axis=1).sum()
landscape = draw_landscape(rhos, attractor.time, misfit / total, lengths=(1.0, 5.0, 20.0))

# %%
# Multiple shooting from the same record, its parameters 20 % off to begin with. States start on the
# smoothed samples.

model = bayesoleo.system("lorenz")
found = multiple_shooting(model, [record], start=[12.0, 22.4, 3.2], backend="numpy")
print(found)

# %%
# One component is enough where it determines the others. From ``x`` alone - the other two start at
# their declared guess - the parameters come back too, and with them what was not measured.

alone = multiple_shooting(
    model, [attractor.record(7, "x")], start=[12.0, 22.4, 3.2], backend="numpy"
)
print(alone)
truth = {name: (attractor.time, row) for name, row in zip("xyz", attractor.motion, strict=True)}
hidden = plots.trajectory(alone.trajectories[0], truth=truth)

# %%
# Fifty records of each system, with other noise and another start each time: all three states, or
# one component. Errors are in units of the standard error that each fit states. All of them stay
# below three, and they scatter as they should. Below: the same records by single shooting with as
# many iterations, which ends nowhere near.

study = Study("chaos", slow=True)
table = study.run(chaos.every_spread)
study.text("seeds", lambda: chaos.print_spread(table))
spread = study.figure("spread", lambda: draw_spread(table))
