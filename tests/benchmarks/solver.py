"""Speed, accuracy and success of the periodic solvers, as ratios taken in one run.

Run as ``python tests/benchmarks/solver.py [--json] [--only PART ...]``. The campaign is found
through ``BAYESOLEO_DATA``. What fails counts in keys that end in ``failures``; errors are of the
stroke over its amplitude, against shooting at 1e-12. ``solve_us``, ``default_solve_us`` and
``log_density_ms`` are wall time with all cores, best of several; all other times of solves are CPU
time, summed over threads.

==============  ====================================================================================
``headline``    time per solve and error: backward differences with n = 800, and the default scheme
``density``     one log density of the campaign
``equal``       both schemes at errors of 1e-5 and 1e-8
``scaling``     exponents of the cost
``scipy``       LSODA until the motion repeats (NumPy, plain Python, compiled), solve_bvp
``peers``       CasADi's collocation of the same equations, shooting by Diffrax
``shooting``    shooting against discretisation at equal error
``end_stop``    the adaptive mesh on the stiffest end stop
``resources``   memory, a new model, the import
==============  ====================================================================================
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from functools import cached_property

import equal_error
import other_codes
import peers
import resources
import shooting
import solves
from cases import Case, campaign, cases

from bayesoleo._parallel import available_cores
from bayesoleo.prediction._orbits import periodic_orbit
from bayesoleo.prediction._simulate import RunPlan, motion
from bayesoleo.systems import system

#: Verbeek (1993), section 4.3.3, at the stiffest stop, from 60 periods of LSODA at rtol 1e-9.
END_STOP = RunPlan("end stop", 1.0, {"force": motion(23.0, [20.0])})
STIFFEST, STATE = 1e11, (0.8155908, 1.2154198)
#: One run of each group of the campaign: high, middle, low.
REPRESENTATIVE = "dim"


class Benchmark:
    """The campaign's figures; what several parts need is made once."""

    def __init__(self) -> None:
        self.model = system("f16n2d1")

    @cached_property
    def records(self) -> list:
        return campaign()

    @cached_property
    def cases(self) -> list[Case]:
        return cases(self.model, self.records)

    @cached_property
    def solve_times(self) -> dict[str, float]:
        return solves.headline(self.model, self.records)

    def headline(self) -> dict[str, float]:
        return self.solve_times | solves.accuracy(self.model, self.cases)

    def density(self) -> dict[str, float]:
        return solves.log_density(self.records)

    def equal(self) -> dict[str, float]:
        chosen = [case for case in self.cases if case.record.label in REPRESENTATIVE]
        return equal_error.measure(self.model, chosen)

    def scaling(self) -> dict[str, float]:
        return solves.scaling(self.model, self.records)

    def scipy(self) -> dict[str, float]:
        """Ratios to backward differences on all cores and on one, and to the default scheme."""
        found, ours = other_codes.measure(self.model, self.cases), self.solve_times
        for name in other_codes.NAMES:
            theirs = 1e3 * found[f"{name}_ms"]
            found[f"{name}_ratio"] = theirs / ours["solve_us"]
            found[f"{name}_ratio_one_core"] = theirs / ours["solve_cpu_us"]
            found[f"{name}_ratio_default"] = theirs / ours["default_solve_us"]
        return found

    def peers(self) -> dict[str, float]:
        return peers.measure(self.model, self.cases)

    def shooting(self) -> dict[str, float]:
        return {f"shooting_{key}" if key != "shooting_ratio" else key: value
                for key, value in shooting.measure().items()}  # fmt: skip

    def end_stop(self) -> dict[str, float]:
        """Errors of position and velocity at phase zero."""
        answer = periodic_orbit(
            system("end_stop"), END_STOP, {"stop_stiffness": STIFFEST}, "adaptive",
            tolerance=1e-6, stiffness="stop_stiffness", backend="numpy",
        )  # fmt: skip
        errors = abs(answer.orbits[0].states[0] - STATE)
        return {
            "end_stop_error_1e11": float(errors[0]),
            "end_stop_velocity_error_1e11": float(errors[1]),
            "end_stop_steps": answer.orbits[0].states.shape[0],
            "end_stop_failures": int(not answer.orbits[0].status.ok),
        }

    def resources(self) -> dict[str, float]:
        return resources.new_model() | resources.peak_memory()

    @property
    def parts(self) -> dict[str, Callable[[], dict[str, float]]]:
        """All parts by name, the ones first that other work in this process would slow down."""
        names = ("headline", "density", "scaling", "equal", "shooting", "end_stop", "resources")
        return {name: getattr(self, name) for name in (*names, "scipy", "peers")}


def main() -> None:
    parts = Benchmark().parts
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="one flat object")
    parser.add_argument("--only", nargs="+", choices=parts, default=list(parts), metavar="PART",
                        help=f"of {', '.join(parts)}")  # fmt: skip
    asked = parser.parse_args()
    result: dict[str, float] = {"cores": available_cores()}
    for name in asked.only:
        found = parts[name]()
        result |= found
        if not asked.json:
            print(name, flush=True)
            for key, value in found.items():
                print(f"    {key:45s} {value:.4g}", flush=True)
    if asked.json:
        known = {key: value if math.isfinite(value) else None for key, value in result.items()}
        print(json.dumps(known))


if __name__ == "__main__":
    main()
