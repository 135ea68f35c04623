r"""
Folds of a Duffing oscillator
=============================

An oscillator with a stiffening spring (Duffing 1918) can have three periodic responses to one
force. Two are stable, the one between them is not. Where it meets one of the others both vanish, at
a fold, and the response jumps. This page follows the branch through its folds, shows its stable
part, and shows how an estimate detects a jump.
"""

# %%
# The declared oscillator of 1 kg, 0.5 N s/m and 100 N/m with a cubic spring, under a force of 6 N.
# One call follows the response over the frequency. A step goes along the branch, not along the
# frequency, so the branch may turn back (pseudo-arclength continuation, Keller 1977).

from dataclasses import replace

import numpy as np

import bayesoleo
from bayesoleo import plots
from bayesoleo.data import HarmonicBasis, significant_harmonics
from bayesoleo.estimation import CampaignProblem, estimate
from bayesoleo.prediction import Predictor, RunPlan, follow_branch, motion, record_of

model = bayesoleo.system("duffing")
plan = RunPlan("sweep", 1.0, {"force": motion(0.0, [6.0])})
branch = follow_branch(model, plan, "frequency", (0.5, 6.0), longest=0.02, steps=64)
figure = plots.branch(branch, "displacement")

# %%
# Below the response are the sizes of the Floquet multipliers: by how much a small disturbance grows
# in one period. On the dashed part one of them is larger than one, and at a fold it is one exactly.
# Their product is :math:`e^{-c T / m}` everywhere, since the damping is linear. At 0.65 Hz the
# third harmonic of the answer resonates, just enough for two folds of its own.

for fold in branch.branch.of_kind("fold"):
    product = np.prod(fold.multipliers).real
    print(
        f"fold at {fold.value:.6f} Hz, swing {1e3 * branch.swing_of(fold, 'displacement'):.2f} mm, "
        f"multipliers {fold.multipliers.real.round(6)}, "
        f"product {product:.6f} = exp(-c T / m) = {np.exp(-0.5 / fold.value):.6f}"
    )

# %%
# The response over the force, at 2.5 Hz. With increasing force a rig stays on the small response
# until the fold and jumps; with decreasing force it stays on the large one.

loud = RunPlan("level", 2.5, {"force": motion(0.0, [6.0])})
along_force = follow_branch(model, loud, "amplitude", (0.02, 2.0), longest=0.02, steps=64)
level_figure = plots.branch(along_force, "displacement")

# %%
# An estimate changes the parameters and may cross a fold. Here the stiffness goes from 100 to 140
# N/m, and each solution starts from the last one, as in an estimate. At 125 N/m the small response
# vanishes. Newton's method then finds the large one. Small steps do not lead there, so the solver
# reports a jump.

record = record_of(model, replace(loud, periods=4))
blank = replace(record, samples=record.samples | {"displacement": np.zeros(record.time.size)})
walker = Predictor(model, [blank], steps=64, backend="numpy")
theta = walker.layout.start(model)
place = walker.layout.names.index("stiffness")
walk = np.arange(100.0, 141.0, 5.0)
answers = []
walker.set_anchor(theta)
for theta[place] in walk:
    answers.append(walker.evaluate(theta)[0])
    text = "  <- jumped to another branch" if answers[-1].jumped else ""
    swing = f"swing {500 * np.ptp(answers[-1].y):.1f} mm" if answers[-1].status.ok else "none found"
    print(f"{theta[place]:4.0f} N/m: {swing}{text}")

span = {"span": (80.0, 140.0), "longest": 0.02, "steps": 64}
small = follow_branch(model, loud, "stiffness", **span)
large = follow_branch(model, loud, "stiffness", downward=True, **span)
walk_figure = plots.branch([small, large], "displacement")
axes = walk_figure.axes[0]
axes.plot(walk, [500 * np.ptp(a.y) for a in answers], "k.", ms=7, zorder=6)
axes.set_xlim(80.0, 140.0)

# %%
# An estimate on the wrong branch: the record has the large response at 150 N/m, the solutions start
# on the small one. The first fit cannot find the truth, and reports the jump. The second fit starts
# from the measured motion, as records of a campaign do, and is on the right branch from the
# beginning.

one = model.fixing("damping", "cubic_spring")
maker = Predictor(one, [blank], steps=64, backend="numpy")
maker.set_anchor(np.array([150.0]))
y = maker.evaluate(np.array([150.0]))[0].y[0]
y = y + 1e-3 * np.random.default_rng(2).standard_normal(y.size)
measured = replace(record, samples=record.samples | {"displacement": y})
print(estimate(CampaignProblem(Predictor(one, [measured], steps=64, backend="numpy")), "mbe"))

basis = HarmonicBasis(y.size, record.phase[1] - record.phase[0])
response = significant_harmonics(basis, y)
known = replace(measured, harmonics=measured.harmonics | {"displacement": response})
print(estimate(CampaignProblem(Predictor(one, [known], steps=64, backend="numpy")), "mbe"))
