r"""
Finding the period of a record
==============================

A shaker repeats its motion, but a period is not a whole number of samples. This page finds the
period of a noisy record by the method of Verbeek (1993), appendix B. It then maps the record to a
grid of one period in two ways, and tests for drift.
"""

# %%
# A pressure that follows a stroke at 0.2 Hz, recorded for four periods at 100.3 Hz with 3 kPa of
# noise. The gas warms up a little: the mean rises by 4 kPa over the record.

import matplotlib.pyplot as plt
import numpy as np

from bayesoleo import plots
from bayesoleo.data import (
    autocovariance,
    drift,
    find_frequency,
    on_grid,
    period_search,
    periodic_average,
)

FREQUENCY, STEP = 0.2, 1 / 100.3
time = STEP * np.arange(int(4 / (FREQUENCY * STEP)))


def pressure(phase):
    """A polytrope over a sinusoidal stroke, Pa."""
    return 4.9e5 * (1 - 3.787 * (0.13 + 0.08 * np.sin(2 * np.pi * phase))) ** -1.1


rng = np.random.default_rng(0)
rise = 4e3 * (time / time[-1] - 0.5)
record = pressure(FREQUENCY * time) + rise + rng.normal(0.0, 3e3, time.size)

# %%
# The residual time shift function :math:`\frac1n \sum (y_\mu - y_{\mu+\eta})^2` falls to the noise
# where the shift is a period; the autocovariance has its maximum there. The minimum of a quadratic
# through the values near one period is the estimate. The declared frequency is 2 % off here.

search = period_search(record, STEP, nominal=1.02 * FREQUENCY)
figure = plots.period_search(search, unit="Pa", name="pressure")

# %%
# This is accurate to a fraction of a sample. Least squares on all harmonics above the noise then
# uses all periods at once, and the whole length of the record determines the frequency.

refined = find_frequency(record, STEP, FREQUENCY)
shifts = np.arange(450, 550)
by_covariance = 1 / (STEP * shifts[np.argmax(autocovariance(record, shifts))])
for name, value in (
    ("highest autocovariance", by_covariance),
    ("quadratic at one period", search.frequency),
    ("least squares on harmonics", refined.value),
):
    print(f"{name:27} {value:.7f} Hz, off by {1e6 * (value / FREQUENCY - 1):8.1f} ppm")
print(f"{'its standard deviation':27} {refined.sd:.7f} Hz")

# %%
# A solver needs a regular grid. Linear interpolation of one period, as in the thesis, keeps all of
# the noise of that period. The band-limited map averages the four periods and adds no error.

points = 800
truth = pressure(np.arange(points) / points)
print("\nroot mean square error on the grid")
for method in ("linear", "band-limited"):
    error = on_grid(record, STEP, refined.value, points, method=method) - truth
    print(f"{method:13} {np.sqrt(np.mean((error - error.mean()) ** 2)) / 1e3:5.2f} kPa")
print(f"expected of an average over four periods: {3 / np.sqrt(4):.2f} kPa")

# %%
# The average over periods also measures the noise without any model: noise is the part that does
# not repeat. A drift does not repeat either, so it needs a test of its own. The test finds it with
# the right size, and ``bayesoleo reduce`` would warn of it.

average = periodic_average(record, STEP, refined.value)
found = drift(record, STEP, refined.value, "pressure")
print(f"\nnoise of a sample {average.sigma / 1e3:.2f} kPa")
print(
    f"mean moves by {found.mean / 1e3:.2f} ± {found.mean_sd / 1e3:.2f} kPa over the record,"
    f" amplitude by {100 * found.amplitude:.2f} ± {100 * found.amplitude_sd:.2f} %"
)

rest = record - average.values
figure_drift, axes = plt.subplots(figsize=(10, 2.8), layout="constrained")
axes.plot(time, rest / 1e3, ".", ms=2, color="#8a919c", label="record less its average")
axes.plot(time, found.mean * (time / time[-1] - 0.5) / 1e3, color="#d55e00", lw=2, label="trend")
axes.set(xlabel="time in s", ylabel="pressure in kPa")
axes.legend(frameon=False, ncols=2)
