r"""
Table 6.2 computed from table 6.5
=================================

Table 6.5 of Verbeek (1993) has the thermo-mechanical model's parameters for each of fourteen
shaker runs, table 6.2 the mechanical model's. Both describe the same measurements, so the one
must follow from the other: simulate each run with its row of table 6.5, fit the mechanical model
to that, and out comes table 6.2, if the print is right.
"""

# %%
# It is not clear what the print says. The solubility coefficient :math:`\theta_7` stands there as
# :math:`-1.42 \cdot 10^{-4}` 1/K, which makes gas *appear* as the pressure rises; the text and its
# figure say that gas disappears, which needs the other sign. And :math:`\theta_5` = 1740 Pa/K goes
# with the positive sign only, if the pressure at rest is to be 4.9 bar. So there are three
# readings:

import matplotlib.pyplot as plt
import numpy as np

from bayesoleo.plots import Study
from bayesoleo.systems import SHAKER_RUNS, TABLE_6_2

VARIANTS = ("printed sign, θ5 = 1603", "printed sign, θ5 = 1740", "physical sign, θ5 = 1742")
for variant in VARIANTS:
    print(variant)

# %%
# The displacement is prescribed at the nominal amplitudes of table 5.1. The refit is driven by the
# simulated force and predicts the displacement, as in the thesis: :math:`\theta_4, \theta_6,
# \theta_7` by MBE with :math:`\sigma = 0.1 \theta`, everything else fixed. No noise is added. On
# the command line it is ``python tests/benchmarks/tables.py --table 6.5to6.2``.

study = Study("thesis_tables", slow=True, needs=("thesis_tables",))
tables = study.helper("thesis_tables")
found = study.run(lambda: {variant: tables.table_6_5_to_6_2(variant) for variant in VARIANTS})
study.text("comparison", lambda: tables.print_comparison(found))

# %%
# In every reading the mechanical model shows the pattern of the print, though nothing in the
# simulated physics varies like that from run to run: the area falls to two thirds in the high runs,
# the exponent leaves its physical range, and the largest residuals are those of the long, slow
# strokes. It is the heat exchange that the model lacks.
#
# The negative sign brings :math:`\theta_6` twice as near to the print as the positive one, and
# :math:`\theta_4` a little nearer; :math:`\theta_7` does not decide. Against it: with the negative
# sign the gas law has its pole within the stroke of runs *a* and *b*, which then have no orbit, and
# at nominal amplitude the pressures of *c*, *d* and *f* are beyond what the rig can bear; but then
# those amplitudes were not reached, or are not what was printed. The likelier reading is that the
# estimates of table 6.5 were made with the sign as printed, by a code with a slip in it for which
# :math:`\theta_6` made up. It is no proof. The built-in oleo has the physical sign;
# ``f16n2d1_thesis_printed`` keeps the other.


def figure():
    """Print and refit by run, one panel a parameter."""
    figure, panels = plt.subplots(3, 1, figsize=(9, 8), sharex=True, layout="constrained")
    looks = dict(zip(VARIANTS, ("o-", "s:", "^--"), strict=True))
    runs = [run.label for run in SHAKER_RUNS]
    printed = np.array([TABLE_6_2.get(run, [np.nan] * 4)[:3] for run in runs])
    for k, (axes, title) in enumerate(zip(panels, ("θ₄ [10⁻³ m²]", "θ₆ [1/m]", "θ₇"), strict=True)):
        scale = 1e3 if k == 0 else 1.0
        for variant, each in found.items():
            refitted = each["estimate"][:, k].reindex(run=runs)
            axes.plot(refitted.run, scale * refitted, looks[variant], ms=4, lw=1, label=variant)
        axes.plot(runs, scale * printed[:, k], "k*", ms=11, label="table 6.2")
        axes.set_ylabel(title)
    panels[0].legend(frameon=False, ncols=2)
    panels[-1].set_xlabel("run")
    return figure


comparison = study.figure("runs", figure)

# %%
# Run *i* of the print, with :math:`\theta_6 = -4.474`, stands apart from its neighbours in every
# reading. In the runs of the lowest stroke (*l*, *m*, *n*) volume and exponent can stand in for
# each other, and where the estimate ends depends on details such as the sampling.
