r"""
A positioning drive: friction that differs by direction
=======================================================

A motor moves a slide by a ball screw under position feedback (Janot, Gautier and Brunot 2019). The
position is controlled, and the force is the motor's voltage times its gain. The model is a mass
with viscous and Coulomb friction. The record with force pulses is held out.
"""

# %%
# Campaign and model are in ``studies/measured/emps``. ``studies/measured_sets.py``
# closes the loop, as ``bayesoleo close --quick`` does, and keeps the result.

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
# The errors of the samples, beside published ones where the same error has been published. The
# position is that of a simulation by the measured force, without feedback.

study.text("errors", lambda: pages.print_errors(sets.kept("emps"), "emps"))

# %%
# The errors before and after, and the posterior of the effects that were added.

study.text("before_after", lambda: print_before_after(summary, "N", 1.0))

# %%
# The record that was held out.

figure = study.figure("course", lambda: pages.course(tree, "force", "pulses", 1.0, "N"))
