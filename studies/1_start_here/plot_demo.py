r"""
Finding a missing effect in simulated data
==========================================

An oleo is the shock strut of an aircraft: a gas spring with oil damping. This page simulates a
shaker test of one, with a friction effect that the fitted model lacks. The package then has to find
that effect, as it would in measured data. The command ``bayesoleo demo`` does the same.
"""

# %%
# The campaign is a folder as a test rig would write it: one file for each run, and
# ``campaign.toml``. Four runs are fitted. Two are held out to test the prediction.

import json
import tempfile
from pathlib import Path

import bayesoleo as bo

campaign = bo.Campaign.demo(Path(tempfile.mkdtemp()) / "campaign", seed=0)
problem = bo.Problem(campaign, bo.system("f16n2d2"), seed=0, quick=True)
print(problem.check())

# %%
# ``explain`` tests every effect of the catalogue, adds the best one, estimates the model again and
# compares the errors. It stops when no effect is significant. ``sample`` then draws from the
# posterior of the extended model.

found = problem.fit(progress=False).explain(progress=False)
posterior = found.sample(progress=False)
print(found)

# %%
# Each bar is an effect of the catalogue, with the share of the excess error that it would explain.
# The scores need no new fit. Effects with the same letter are equivalent for these data.

ranking = bo.plots.ranking(found.tree, most=10)

# %%
# The true values are known here. The effect that was put in is the one that was found, and most
# parameters lie within two standard deviations of their true values.

TRUTH = {
    "piston_area": 3.449e-3,
    "initial_volume": 9.274e-4,
    "friction_base": 78.0,
    "friction_per_pressure": 1.6e-5,
    "friction_slope": 4080.0,
    "solubility": -1.334e-8,
    "heat_conduction": 1.925,
    "stribeck_friction": 140.0,
    "stribeck_friction_decay": 0.006,
}
print("put in: stribeck_friction")
print("found: ", ", ".join(found.effects))
print(f"{'parameter':26}{'truth':>12}{'estimate':>12}{'sd':>10}  off by (sd)")
for name, row in json.loads(found.tree.attrs["summary"])["parameters"].items():
    if name in TRUTH:
        off = (row["estimate"] - TRUTH[name]) / row["sd"]
        print(f"{name:26}{TRUTH[name]:12.4g}{row['estimate']:12.4g}{row['sd']:10.2g}{off:8.1f}")

# %%
# The error of each run, before and after. At 1 the repeating part of the residual is as large as
# noise alone would make it: nothing is missing any more.

error = found.plot()

# %%
# The force that the first model could not explain, over one period. The grey band is one standard
# error of the average. Friction that falls as the strut breaks away leaves a spike at each reversal
# of the motion.

residual = bo.plots.residual(found.tree, "force")
# sphinx_gallery_thumbnail_number = -1
