r"""
A pendulum that swings freely
=============================

A pendulum is let go and swings (dynamicslab, MultiArm-Pendulum). Four records are for the fit, two
for the validation. Nothing drives it. The model has gravity and a viscous bearing. Over many swings
a small error of the frequency becomes a large error of the angle.
"""

# %%
# Campaign and model are in ``studies/measured/single_pendulum``. ``studies/measured_sets.py``
# closes the loop, as ``bayesoleo close --quick`` does, and keeps the result.

# sphinx_gallery_thumbnail_number = -1
import json

import bayesoleo as bo
from bayesoleo.gallery import Study, print_before_after

needs = ("measured_sets", "measured_pages")
study = Study("single_pendulum", data="measured/single_pendulum", slow=True, needs=needs)
sets, pages = study.helper("measured_sets"), study.helper("measured_pages")
tree = study.run(lambda: sets.tree_of("single_pendulum"))
summary = study.run(lambda: json.loads(tree.attrs["summary"]))
study.text("summary", lambda: print(bo.Explanation(tree)))

# %%
# The errors of the simulated angle.

study.text("errors", lambda: pages.print_errors(sets.kept("single_pendulum"), "pendulum"))

# %%
# The errors before and after, and the posterior of the effects that were added.

study.text("before_after", lambda: print_before_after(summary, "mrad", 1e3))

# %%
# A record that was held out; its first angle and velocity are estimated.

figure = study.figure("course", lambda: pages.course(tree, "angle", "validation 1", 1e3, "mrad"))

# %%
# The error falls to a half, and what was found is a likeness: power-law damping, and Dahl friction,
# which these data do not tell from Coulomb and other friction, nor from quadratic damping. Dry
# friction with drag of the air is a pair, and no effect alone. The quick search ends there. Before
# it was limited it went on for twelve minutes of computing, and reached 0.37 and 2.8 mrad with a
# constant force of each run's own, an end stop and a function of the velocity besides: all six
# records are pieces of one decay, from 1.6 rad to 0.3, so that what differs from run to run is what
# changes with the amplitude. ``python tests/benchmarks/measured_limits.py --only pendulum`` fits
# them by code of its own: sharp Coulomb friction, drag and a constant force leave 0.94 mrad of the
# fitted records and 4.3 mrad of the others. Friction over a wide range of velocities leaves 0.84
# and 9.5 mrad: the fitted records prefer the law that predicts worse.
