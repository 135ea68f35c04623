r"""
A pendulum that swings until it stands
======================================

A pendulum was let go from several angles, and its angle was recorded until it stood (MultiArm-
Pendulum, dynamicslab). Nothing drives it. The model has a viscous bearing only. Two records are
held out.
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
# The errors of the samples, beside published ones where the same error has been published. Of
# each record only the start is estimated.

study.text("errors", lambda: pages.print_errors(sets.kept("single_pendulum"), "pendulum"))

# %%
# The errors before and after, and the posterior of the effects that were added.

study.text("before_after", lambda: print_before_after(summary, "mrad", 1e3))

# %%
# The record that was held out.

figure = study.figure("course", lambda: pages.course(tree, "angle", "validation 1", 1e3, "mrad"))
