r"""
A friction damper with play in its joint
========================================

A band rubs on a drum; its lever is turned through a joint that has backlash (Coble, Huggins, Cao,
Ricles and Downey 2022). The displacement is controlled, and the force is measured. The model is
Coulomb friction with viscous damping. The run at 1 Hz and 1 in is held out.
"""

# %%
# Campaign and model are in ``studies/measured/brfd``. ``studies/measured_sets.py``
# closes the loop, as ``bayesoleo close --quick`` does, and keeps the result.

# sphinx_gallery_thumbnail_number = -1
import json

import bayesoleo as bo
from bayesoleo.gallery import Study, print_before_after

needs = ("measured_sets", "measured_pages")
study = Study("brfd", data="measured/brfd", slow=True, needs=needs)
sets, pages = study.helper("measured_sets"), study.helper("measured_pages")
tree = study.run(lambda: sets.tree_of("brfd"))
summary = study.run(lambda: json.loads(tree.attrs["summary"]))
study.text("summary", lambda: print(bo.Explanation(tree)))

# %%
# The errors of the samples, beside published ones where the same error has been published.

study.text("errors", lambda: pages.print_errors(sets.kept("brfd"), "brfd"))

# %%
# The errors before and after, and the posterior of the effects that were added.

study.text("before_after", lambda: print_before_after(summary, "kip", 0.00022480894387096184))

# %%
# A run that was held out.

figure = study.figure(
    "course", lambda: pages.course(tree, "force", "1 Hz 1 in", 0.00022480894387096184, "kip")
)

# %%
# At each reversal the force stays near zero while the joint crosses its play. When it has
# closed the force rings, which no periodic function of displacement and velocity describes.
#
# ``python tests/benchmarks/measured_limits.py --only brfd`` fits an elastic slider with backlash in
# series to each run by itself, without the loop. It leaves 0.37 kip in the run at 1 Hz and 1 in,
# and 0.16 kip in the one at 0.5 Hz. Faster parts than 20 Hz, the ringing, are 0.21 kip of the
# former and 0.05 kip of the latter.
