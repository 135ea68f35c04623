r"""
Seven measured sets, side by side
=================================

What the loop finds in measured systems, with the errors beside those that have been published for
the same records. A black box of the literature is trained on tens of thousands of samples and
names no cause. Here a model of one equation is completed by named effects.
"""

# %%
# ``python tests/benchmarks/measured.py`` closes the loop on all sets, and ``python
# studies/measured_sets.py --store`` keeps the figures of this page. The published errors, with
# their sources, are in ``studies/measured_pages.py``.

# sphinx_gallery_thumbnail_number = -1
from bayesoleo.gallery import Study

study = Study("measured_sets", data="measured", slow=True, needs=("measured_pages",))
pages = study.helper("measured_pages")
study.text("errors", lambda: pages.print_all_errors())

# %%
# Where an error has been published, ours is drawn over the smallest of them. Left of one the loop
# leaves less than that. The Silverbox is simulated with the offset of its sensor, 0.70 mV, as the
# block shows it that was fitted.

figure = study.figure("beside", lambda: pages.beside_published())

# %%
# What was found, how sure it is, and the wall time of the search on two cores that other work
# shared.

study.text("found", lambda: pages.print_all_found())

# %%
# A *likeness* is not a finding: something is left that no effect of the catalogue explains, and
# what stands there is most like it. What the friction damper and the drive can give at best is
# printed by ``python tests/benchmarks/measured_limits.py``.
