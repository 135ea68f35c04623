r"""
Two tanks: water that overflows
===============================

A pump fills the upper of two tanks, which empties through a hole into the lower one (Schoukens and
Noël 2017). Only the level of the lower tank is measured. The model has both outflows, each in
proportion to the square root of the level, and no overflow. The validation record is held out.
"""

# %%
# Campaign and model are in ``studies/measured/cascaded_tanks``. ``studies/measured_sets.py`` closes
# the loop, as ``bayesoleo close --quick`` does, and keeps the result. The level at which the upper
# tank begins is not measured.

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
# The errors of the simulated level, beside published ones where the same error has been published.

study.text("errors", lambda: pages.print_errors(sets.kept("cascaded_tanks"), "tanks"))

# %%
# The errors before and after, and the posterior of the effects that were added.

study.text("before_after", lambda: print_before_after(summary, "V", 1.0))

# %%
# The validation record.

figure = study.figure("course", lambda: pages.course(tree, "level", "validation", 1.0, "V"))
