r"""
How often probabilities of structures are right
===============================================

The search for missing effects ends in probabilities: that nothing is missing, that an effect of the
catalogue acts, or that something outside of it does. Of all statements that are made with a
probability of 0.9, nine in ten should be true. This is tested on simulated campaigns whose truth is
known.
"""

# %%
# An example first: the model of the demonstration campaign lacks one effect, and ``explain``
# compares the structures. A column stands for each of the leading ones, with its probability on top
# and a dot for each member.

# sphinx_gallery_thumbnail_number = -1
import tempfile
from pathlib import Path

import bayesoleo as bo
from bayesoleo.gallery import Study

campaign = bo.Campaign.demo(Path(tempfile.mkdtemp()) / "campaign", seed=0)
problem = bo.Problem(campaign, bo.system("f16n2d2"), seed=0, quick=True)
found = problem.fit(progress=False).explain(progress=False)
example = bo.plots.structures(found.tree)

# %%
# Many campaigns
# --------------
#
# The study draws linear and Duffing oscillators under a measured force, two coupled masses, a
# heated body, the force law of a damper, and an oleo (the shock strut of an aircraft). A quarter of
# the campaigns lack nothing. The others lack one effect of the catalogue, two of them, or a law
# that the catalogue does not have, each at one to ten times the detection limit. In half of the
# campaigns the measured input has noise of its own.
#
# Effects are drawn in two ways. One takes them from the whole catalogue, as often as the default
# prior says. The other takes sixteen usual ones, which a simulator without any code of the package
# computes.
#
# A statement about an effect is true if the effect acts. Effects whose changes of the outputs are
# exactly equal count as one. Of effects that merely resemble each other only the one that acts is
# true, so a probability that is shared between them is right if each gets its part.

study = Study("structures", needs=("structure_figures",))
figures = study.helper("structure_figures")
if study.live:
    figures.print_figures()

# %%
# Part of the statements that is true, by the probability with which they were made, with 90 %
# intervals and the number of statements. Points below the line promise too much, points above it
# too little.
#
# Of laws that are nearly one, such as Dahl's friction and LuGre's, the sixteen effects have one
# only. The other keeps its share of the probability but is never the cause, so that statements
# about the one promise too little. Under a prior of the sixteen effects alone most statements are
# sure, and as many of them are true as they say.

figure = study.run(lambda: figures.reliability_figure())
