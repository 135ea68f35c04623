r"""
Silverbox: from a linear to a hardening spring
==============================================

The Silverbox is an electronic circuit that behaves like a mass on a hardening spring, driven by an
odd multisine (Wigren and Schoukens 2013). It is fitted here with a model whose spring is linear,
and the loop has to find out.
"""

# %%
# The model is as short as its equation; it and the campaign's declaration are in
# ``studies/measured/silverbox``. Block 1 is fitted, block 2 is held out.

import json

import matplotlib.pyplot as plt
import numpy as np
from rich.console import Console

import bayesoleo
import bayesoleo._report
import bayesoleo._workflow
from bayesoleo.effects import called
from bayesoleo.model import Model, Output, Parameter
from bayesoleo.plots import Study, print_before_after

model = Model(
    "linear circuit",
    inputs={"input_voltage": "V"},
    dofs={"y": "V"},
    parameters={
        "damping": Parameter(50.0, "1/s", sd=50.0, bounds=(0.0, 1e4)),
        "stiffness": Parameter(2.0e5, "1/s**2", sd=1e5),
        "gain": Parameter(2.0e5, "1/s**2", sd=1e5),
    },
    equations={
        "y": {
            "inertia": "ddot(y)",
            "damping": "damping*dot(y)",
            "spring": "stiffness*y",
            "drive": "-gain*input_voltage",
        }
    },
    outputs={"output_voltage": Output("y", "V")},
)
study = Study("silverbox", data="measured/silverbox", slow=True)
for line in bayesoleo.systems.equations(model).values():
    print(line)

# %%
# Closing the loop.

tree = study.run(
    lambda: bayesoleo._workflow.closing.close(
        study.campaign, model, bayesoleo.Settings(seed=0, quick=True)
    )
)
summary = tree and json.loads(tree.attrs["summary"])
study.text("summary", lambda: bayesoleo._report.terminal.print_summary(summary, Console(width=100)))

# %%
# Round by round, on the block that was not used for fitting. The cubic spring comes first and takes
# almost everything.


def rounds():
    """Error of the hold-out block in each round, and what was added then."""
    print("round  repeating  / expected   added")
    for number, entry in enumerate(summary["rounds"], 1):
        error = entry["error"]["output_voltage"]["block 2"]
        repeating = f"{1e3 * error['repeating']:6.3f} mV {error['ratio_to_expected']:11.1f}"
        print(f"{number:5}  {repeating}   {called(entry['accepted'] or '–', summary['titles'])}")
    last = summary["rounds"][-1]["error"]["output_voltage"]["block 2"]
    reached = "reached" if last["repeating"] < 0.39e-3 else "missed"
    print(f"The mark set beforehand, 0.39 mV repeating on the hold-out block, is {reached}.")


study.text("rounds", rounds)

# %%
# Before and after on both blocks, and the posterior of everything that was added.

study.text("before_after", lambda: print_before_after(summary, "mV", 1e3))

# %%
# The verdict is not that nothing is missing: the ratio to the noise stays well above 1. The rounds
# after the first add small terms, some of which the data cannot tell from others.
#
# Spectra of the hold-out block show where the error was. The record holds whole periods, so all
# that repeats falls on the harmonics of the period, and between them there is only noise.


def spectrum(values):
    """Complex amplitudes of whole periods, in mV."""
    return 2e3 * np.fft.rfft(values.dropna("sample")) / values.dropna("sample").size


def block(group):
    """One group of the result, of the hold-out block alone."""
    return tree[group].to_dataset().sel(run="block 2")


def spectra():
    """Amplitudes of the residual before and after, and of the noise between the harmonics."""
    facts, residual = block("constant_data"), block("residual")
    periods, frequency = round(float(facts["periods"])), float(facts["frequency"])
    figure, axes = plt.subplots(figsize=(10, 4.2), layout="constrained")
    for name, colour, label in (
        ("output_voltage_before", "#d55e00", "residual of the linear model"),
        ("output_voltage_after", "#0072b2", "residual after the loop has closed"),
    ):
        lines = np.abs(spectrum(residual[name]))
        harmonics = lines[periods::periods]
        place = frequency * np.arange(1, harmonics.size + 1)
        axes.semilogy(place, harmonics, ".", ms=4, color=colour, label=label)
    # The lines between two harmonics, without those that leak from them.
    between = lines[: harmonics.size * periods].reshape(-1, periods)[:, 2:-1]
    noise = np.sqrt(np.mean(between**2, axis=1))
    axes.plot(place, noise, color="#9aa1ab", lw=1.2, zorder=0, label="noise, between harmonics")
    axes.set(xlabel="frequency in Hz", ylabel="amplitude in mV", xlim=(0, 260), ylim=(3e-4, 20))
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="upper right", markerscale=3)
    return figure


figure = study.figure("spectrum", spectra)

# %%
# Before, the error stands up below and around the resonance. What is left after is a hump at three
# times the resonance, where the circuit is no longer driven: the third harmonics that the cubic
# spring itself makes. The fitted model has them, in about the right size, with another phase:


def hump():
    """The model's third harmonics over the measured ones."""
    frequency = float(block("constant_data")["frequency"])
    periods = round(float(block("constant_data")["periods"]))
    measured = spectrum(block("records")["output_voltage"])[::periods]
    model = spectrum(block("prediction")["output_voltage_after"])[::periods]
    near = slice(round(210 / frequency), round(225 / frequency))
    ratio = np.vdot(measured[near], model[near]) / np.vdot(measured[near], measured[near])
    print(f"210 to 225 Hz: size {abs(ratio):.2f}, phase {np.degrees(np.angle(ratio)):+.0f}°")


study.text("hump", hump)

# %%
# That is no matter of the mesh, which is refined until the estimate stays, and neither an effect of
# the catalogue nor the function without a name explains it: an open question of this circuit, or of
# the chain that measured it.
