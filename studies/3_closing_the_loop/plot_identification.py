"""
How often the right effect is named
===================================

Data are made with an effect that the model lacks, and the loop is asked what is missing. Each
effect of the catalogue that an oleo can show is put into six-run campaigns - four to fit, two held
out, from a creep of 15 mm at 0.02 Hz over 110 mm at 0.1 Hz to 30 mm at 3 Hz - at 1, 3 and 10 times
its detection limit, the size that a score finds significant in half of all campaigns. Two hundred
campaigns lack nothing; in others something acts that the catalogue has no name for, and the loop
may take a name that is like it, but must not call it certain.

What the table below says against the loop: two of 1145 campaigns failed. At three times the limit
284 of 300 answers are right alone or in a class of three at most, but only 192 are one name that is
right. At ten times the limit one of 227 answers that were called certain is wrong: Coulomb
friction was called power-law damping. Of 45 campaigns with something outside the catalogue 14 were
given a likely name, nine of them with the verdict ``effect added``; none was called certain.

The rows were computed before errors were held against what is expected of them and before final
models were compared (the changelog lists both under "Changed"); with these rules they have not been
computed anew.
"""

# %%
# The table is that of the command it names; where it is not finished, it is an even sample.

from bayesoleo.plots import Study

study = Study("identification", needs=("identification_figures", "identification_rows"))
figures, campaigns = study.helper("identification_figures"), study.helper("identification_rows")
table = study.run(lambda: campaigns.stored())
if table:
    print(table["command"])
    figures.print_table(table)

# %%
# What comes out
# --------------
#
# Effects that explain the data as well are reported together, as a class; the answer counts as
# right where the class has three members at most and the true effect is one of them. At the
# detection limit itself half must be missed, and more are, because what is found has to prove
# itself on runs that were not used.

figure = study.run(lambda: figures.outcome_figure(table["rows"]))

# %%
# Which is taken for which
# ------------------------
#
# A row is the effect in the data, a column what the loop named. Off the diagonal are effects that
# do nearly the same to these six runs: the catalogue is longer than what six runs can tell apart.

figure = study.run(lambda: figures.confusion_figure(table["rows"], 3.0))

# %%
# By family
# ---------
#
# With exact 90 % intervals of a fraction.

figure = study.run(lambda: figures.power_figure(table["rows"]))
