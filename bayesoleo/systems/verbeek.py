"""Published values of Verbeek (1993): the shaker grid and the estimates run by run.

Numbers as printed; what is illegible in the scan is NaN. They are what a reproduction is held
against, and no default of any model.
"""

from __future__ import annotations

from dataclasses import dataclass

NAN = float("nan")


@dataclass(frozen=True)
class ShakerRun:
    """A run of the shaker tests.

    Parameters
    ----------
    label, group : str
        Tables 5.1 and 5.2; the group is the static position.
    frequency : float
        Hz.
    position, amplitude : float
        Static position and amplitude of the stroke, m.
    """

    label: str
    group: str
    frequency: float
    position: float
    amplitude: float


#: Tables 5.1 and 5.2. Run a was run over the full stroke and the amplitude of b is illegible; both
#: are given the largest that stays off the stops, and k and m are trimmed to a stroke that stays
#: positive.
SHAKER_RUNS = (
    ShakerRun("a", "middle", 0.04, 0.133, 0.130),
    ShakerRun("b", "middle", 0.1, 0.133, 0.130),
    ShakerRun("c", "high", 0.2, 0.179, 0.075),
    ShakerRun("d", "high", 0.5, 0.219, 0.032),
    ShakerRun("e", "high", 1.0, 0.229, 0.020),
    ShakerRun("f", "high", 2.0, 0.249, 0.010),
    ShakerRun("g", "middle", 0.2, 0.133, 0.078),
    ShakerRun("h", "middle", 0.5, 0.133, 0.034),
    ShakerRun("i", "middle", 1.0, 0.133, 0.021),
    ShakerRun("j", "middle", 2.0, 0.133, 0.010),
    ShakerRun("k", "low", 0.2, 0.079, 0.078),
    ShakerRun("l", "low", 0.5, 0.039, 0.035),
    ShakerRun("m", "low", 1.0, 0.017, 0.016),
    ShakerRun("n", "low", 2.0, 0.014, 0.010),
)

#: Table 6.2, mechanical model, by run: theta_4 in m**2, theta_6 in 1/m, theta_7, and the largest
#: residual in m. Runs j and n did not converge.
TABLE_6_2: dict[str, tuple[float, float, float, float]] = {
    "a": (3.198e-3, -3.788, 0.974, 15e-3),
    "b": (2.872e-3, -3.734, 1.163, 20e-3),
    "c": (2.205e-3, -3.619, 1.382, 11e-3),
    "d": (1.649e-3, -3.574, 1.527, 2e-3),
    "e": (1.480e-3, -3.601, 1.495, 0.7e-3),
    "f": (2.072e-3, -3.742, 1.166, 0.9e-3),
    "g": (3.030e-3, -3.758, 1.198, 9e-3),
    "h": (2.956e-3, -3.810, 1.217, 1e-3),
    "i": (3.201e-3, -4.474, 0.863, 1e-3),
    "k": (3.447e-3, -3.922, 1.101, 5e-3),
    "l": (3.710e-3, -3.810, 1.176, 2e-3),
    "m": (3.857e-3, -3.050, 1.494, 2e-3),
}

#: Table 6.5, thermo-mechanical model, by run: theta_4 in m**2, theta_6 in 1/m, theta_16 in W/K, and
#: the largest residual in m. Theta_16 of a and b is illegible; those of j, m and n were negative,
#: and rejected.
TABLE_6_5: dict[str, tuple[float, float, float, float]] = {
    "a": (3.262e-3, -3.512, NAN, 6e-3),
    "b": (3.227e-3, -3.409, NAN, 3.7e-3),
    "c": (2.941e-3, -3.477, 5.958, 6e-3),
    "d": (3.158e-3, -3.461, 7.189, 2e-3),
    "e": (3.574e-3, -3.439, 7.350, 0.6e-3),
    "f": (3.592e-3, -3.451, 0.928, 0.5e-3),
    "g": (3.607e-3, -3.334, 3.309, 2e-3),
    "h": (3.694e-3, -3.346, 1.533, 0.9e-3),
    "i": (3.710e-3, -3.354, 1.513, 0.9e-3),
    "j": (3.628e-3, -3.437, NAN, 1e-3),
    "k": (3.868e-3, -3.160, 1.957, 3e-3),
    "l": (3.937e-3, -2.981, 0.807, 1e-3),
    "m": (3.970e-3, -2.921, NAN, 2e-3),
    "n": (3.948e-3, -3.390, NAN, 1e-3),
}

#: Table 6.7, which is lost in the scan, rebuilt from table 6.5: mean and standard deviation over
#: runs; theta_16 over the nine that are legible and positive.
TABLE_6_7: dict[str, tuple[float, float]] = {
    "theta_4": (3.580e-3, 0.321e-3),
    "theta_6": (-3.334, 0.184),
    "theta_16": (3.39, 2.70),
}
