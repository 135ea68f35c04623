r"""
Silverbox: from a linear to a hardening spring
==============================================

The Silverbox is an electronic circuit that behaves like a mass on a hardening spring. A sum of odd
harmonics drives it (Wigren and Schoukens 2013). The model fitted here has a linear spring, and the
package has to find the cubic term.
"""

# %%
# Block 1 of the record is fitted, block 2 is held out. ``campaign.toml`` declares both.

# sphinx_gallery_thumbnail_number = -1
import json
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import bayesoleo as bo
from bayesoleo import Model, Output, Parameter
from bayesoleo.effects import called, find_effect
from bayesoleo.gallery import Study, print_before_after
from bayesoleo.prediction import RunPlan, motion

BLOCKS = (("block 1", 17.354, 35.799, "fit"), ("block 2", 195.584, 214.030, "hold-out"))
DECLARATION = """
format = 1
name = "silverbox"
dataset = "silverbox"
channels.input_voltage = {column = "V1", unit = "V", offset = "-mean"}
channels.output_voltage = {column = "V2", unit = "V"}
""" + "".join(
    f"""
[[runs]]
label = "{label}"
file = "Schroeder80mV.mat"
kind = "periodic"
frequency = 0.596
sample_rate = 610.3515625
start = {start}
stop = {stop}
role = "{role}"
"""
    for label, start, stop, role in BLOCKS
)

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

# %%
# First a test with a known answer: a simulated circuit with a cubic spring.

spring = {**model.equations["y"], "spring": "stiffness*y + 1.5e6*y**3"}
truth = Model(
    "hardening circuit", inputs=model.inputs, dofs=model.dofs, parameters=model.parameters,
    equations={"y": spring}, outputs=model.outputs,
)  # fmt: skip
tones = {"input_voltage": motion(0.0, [0.006, 0.0] * 8, 2.4 * np.arange(16) ** 2)}
plans = [RunPlan(role, 8.0, tones, role=role) for role in ("fit", "hold-out")]
folder = Path(tempfile.mkdtemp()) / "circuit"
noise = {"input_voltage": 1e-5, "output_voltage": 1e-4}
simulated = bo.Campaign.simulate(folder, truth, plans, noise=noise)
effects = [find_effect(f"{kind}_stiffness") for kind in ("quadratic", "cubic", "quintic")]
known = bo.Problem(simulated, model).fit().explain(effects=effects, max_effects=1)
print(known.effects, known.verdict)
figure = known.plot()

# %%
# The measured circuit.

study = Study("silverbox", data="measured/silverbox", slow=True, declaration=DECLARATION)
problem = study.run(lambda: bo.Problem(study.campaign, model, seed=0, quick=True))
found = study.run(lambda: problem.fit().explain())
study.run(lambda: found.sample())
tree, summary = found and found.tree, found and json.loads(found.tree.attrs["summary"])
study.text("summary", lambda: print(found))

# %%
# The error of the held-out block, round by round. The cubic spring is added first and removes most
# of the error.


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
# The errors before and after, and the posterior of the effects that were added.

study.text("before_after", lambda: print_before_after(summary, "mV", 1e3))

# %%
# The ratio to the noise stays well above 1, so something is still missing. The later rounds add
# small terms, and the data cannot tell some of them from others.
#
# The spectra of the held-out block show the frequencies of the error. The record holds whole
# periods. Everything that repeats therefore falls on harmonics, and between them is only noise.


def spectra():
    """Amplitudes of the residual before and after, and of the noise between the harmonics."""
    groups = ("constant_data", "residual")
    facts, residual = (tree[group].to_dataset().sel(run="block 2") for group in groups)
    periods, frequency = round(float(facts["periods"])), float(facts["frequency"])
    figure, axes = plt.subplots(figsize=(10, 4.2), layout="constrained")
    for name, colour, label in (
        ("output_voltage_before", "#d55e00", "residual of the linear model"),
        ("output_voltage_after", "#0072b2", "residual after the loop has closed"),
    ):
        values = residual[name].dropna("sample").values
        lines = 2e3 * np.abs(np.fft.rfft(values)) / values.size  # mV
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
# The linear model errs below and around the resonance. The extended model errs at three times the
# resonance, where the circuit is not driven: there are the third harmonics that the cubic spring
# makes. The fitted model has them in about the right size, but with another phase. The mesh is not
# the cause, and no effect of the catalogue explains it. It remains an open question.
