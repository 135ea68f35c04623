r"""
A positioning drive: friction that a constant does not describe
===============================================================

A motor moves a slide under feedback (Janot, Gautier and Brunot 2019). Position and the drive's
voltage are measured for 25 s at 1 kHz. The model is a mass with viscous and Coulomb friction, and
predicts the force from the position. A second record, in which the drive adds pulses, is held out.
"""

# %%
# Campaign and model are in ``studies/measured/emps``. ``studies/measured_sets.py`` closes the loop,
# as ``bayesoleo close --quick`` does, and keeps the result.

# sphinx_gallery_thumbnail_number = -1
import json

import bayesoleo as bo
from bayesoleo.gallery import Study, print_before_after

needs = ("measured_sets", "measured_pages")
study = Study("emps", data="measured/emps", slow=True, needs=needs)
sets, pages = study.helper("measured_sets"), study.helper("measured_pages")
tree = study.run(lambda: sets.tree_of("emps"))
summary = study.run(lambda: json.loads(tree.attrs["summary"]))
study.text("summary", lambda: print(bo.Explanation(tree)))

# %%
# The errors of the force, and of the position if the measured force drives the model that was
# found, beside published ones. The parameters are those that predict the force best.

study.text("errors", lambda: pages.print_errors(sets.kept("emps"), "emps"))

# %%
# The errors before and after, and the posterior of the effects that were added.

study.text("before_after", lambda: print_before_after(summary, "N", 1.0))

# %%
# The record that was held out.

figure = study.figure("course", lambda: pages.course(tree, "force", "pulses", 1.0, "N"))

# %%
# How small can these errors be? ``python tests/benchmarks/measured_limits.py --only emps`` answers
# without the loop. Each pulse begins and ends with a step of 176 N. Above 300 Hz the force is
# 2.7 N, root mean square, and the inertia that the recorded position shows there is 0.004 N: no
# linear function of this position predicts that part. The best one leaves 3.4 N above 20 Hz.
#
# Where force drives the model, nothing holds the slide, and an error of a hundredth of a newton
# moves it by a millimetre in 25 s. The published parameters leave 9.2 mm on the pulses. Mass,
# viscous friction, Coulomb friction of either direction and an offset, fitted to the position of
# the first record, leave 2.5 mm there and 5.0 mm on the pulses. With any force of velocity and a
# cubic force of position it is 1.4 mm and 15 mm, and 0.58 mm if they are fitted to the pulses
# themselves.
