r"""
Two water tanks: one of them overflows
======================================

A pump fills the upper of two tanks, which empties into the lower one, which empties into a
reservoir (Schoukens and Noël 2017). Only the level of the lower tank is measured. The model has no
overflow. The second record is held out.
"""

# %%
# Campaign and model are in ``studies/measured/cascaded_tanks``. ``studies/measured_sets.py``
# closes the loop, as ``bayesoleo close --quick`` does, and keeps the result.

# sphinx_gallery_thumbnail_number = -1
import json

import bayesoleo as bo
from bayesoleo.gallery import Study, print_before_after

needs = ("measured_sets", "measured_pages")
study = Study("cascaded_tanks", data="measured/cascaded_tanks", slow=True, needs=needs)
sets, pages = study.helper("measured_sets"), study.helper("measured_pages")
tree = study.run(lambda: sets.tree_of("cascaded_tanks"))
summary = study.run(lambda: json.loads(tree.attrs["summary"]))
study.text("summary", lambda: print(bo.Explanation(tree)))

# %%
# The errors of the samples, beside published ones where the same error has been published. Of
# each record only the start is estimated.

study.text("errors", lambda: pages.print_errors(sets.kept("cascaded_tanks"), "tanks"))

# %%
# The errors before and after, and the posterior of the effects that were added.

study.text("before_after", lambda: print_before_after(summary, "V", 1.0))

# %%
# The record that was held out.

figure = study.figure("course", lambda: pages.course(tree, "level", "validation", 1.0, "V"))
