r"""
Finding a missing effect in simulated data
==========================================

What ``bayesoleo demo`` does, step by step: a shaker campaign of an oleo, the shock strut of an
aircraft, is simulated with one effect that the fitted model lacks. The loop is then closed on it as
on measured data. It is not told what is missing.
"""

# %%
# The campaign is a folder as a rig would write it: one file a run, and ``campaign.toml``. Four runs
# are fitted, two are held out.

import json
import tempfile
from pathlib import Path

from rich.console import Console

import bayesoleo
import bayesoleo._report
import bayesoleo._workflow
from bayesoleo import plots
from bayesoleo._workflow.simulating import DEMO_EFFECT, DEMO_SYSTEM, DEMO_TRUTH, demo_campaign
from bayesoleo.effects import called

folder = demo_campaign(Path(tempfile.mkdtemp()) / "campaign", seed=0)
model = bayesoleo.system(DEMO_SYSTEM)
for name, value in bayesoleo._workflow.task.check(folder, model).items():
    print(f"{name:16} {value}")

# %%
# One call estimates the parameters, holds the residual against the noise, names what is missing,
# adds it, samples the posterior and compares the error before and after.

tree = bayesoleo._workflow.closing.close(folder, model, bayesoleo.Settings(seed=0, quick=True))
summary = json.loads(tree.attrs["summary"])
bayesoleo._report.terminal.print_summary(summary, Console(width=100))

# %%
# What the first round saw. Each bar is a candidate of the catalogue, scored without a refit by the
# share of the excess error that it would explain. A letter marks candidates that these data cannot
# tell apart.

ranking = plots.ranking(tree, most=10)

# %%
# The truth is known here. The effect that was put in is the one found, and most parameters lie
# within two standard deviations of what made the data:

print("put in:", called(DEMO_EFFECT, {}))
print("found: ", ", ".join(called(effect, {}) for effect in summary["effects"]))
print(f"{'parameter':26}{'truth':>12}{'estimate':>12}{'sd':>10}  off by (sd)")
for name, found in summary["parameters"].items():
    if name in DEMO_TRUTH:
        off = (found["estimate"] - DEMO_TRUTH[name]) / found["sd"]
        row = f"{DEMO_TRUTH[name]:12.4g}{found['estimate']:12.4g}{found['sd']:10.2g}"
        print(f"{name:26}{row}{off:8.1f}")

# %%
# The error of every run, before and after. At 1 the part of the residual that repeats from period
# to period is what noise alone would leave in the average: nothing is missing any more.

error = plots.error(tree)

# %%
# Where the model went wrong: the force that it could not explain, over one period. The grey band is
# one standard error of the average. Friction that drops as the strut breaks away leaves a spike at
# each reversal.

residual = plots.residual(tree, "force")
# sphinx_gallery_thumbnail_number = -1
