"""How small errors of three measured sets can be, by fits of few lines that do not use the loop.

Run with ``python tests/benchmarks/measured_limits.py --json`` for one flat object, or without
``--json`` for a table. The data are found through ``BAYESOLEO_DATA``. NumPy and SciPy compute
everything here; the package only says where the files are.

======================================== ==========================================================
key                                      what it is
======================================== ==========================================================
emps_pulses_force_above_300_Hz_N         force that was commanded above 300 Hz, rms
emps_pulses_inertia_above_300_Hz_N       the published mass times the measured acceleration there
emps_pulses_least_N                      rms that the best linear function of position leaves above
                                         20 Hz
emps_trajectory_least_N                  the same of the record that is fitted
emps_position_published_mm               position on the pulses, simulated from the force with the
                                         published parameters
emps_position_simple_fit_mm, …_pulses_mm simulation with mass, viscous friction, Coulomb friction of
                                         either direction and offset, fitted to the position of the
                                         trajectory; there and on the pulses
emps_position_flexible_fit_mm, …_pulses… the same with any force of velocity (17 knots) and a cubic
                                         force of position
emps_position_flexible_own_mm            the flexible one fitted to the pulses themselves
brfd_<run>_elastic_kip, …_backlash_kip   elastic Coulomb friction, without and with backlash in
                                         series, fitted to that run itself
brfd_<run>_above_20_Hz_kip               force above 20 Hz, rms
pendulum_<damping>_fit_mrad              angle of the four records that are fitted, rms: with
                                         viscous damping, and with Coulomb friction (sharp, or over
                                         a wide range of velocities), drag and a constant force
                                         besides
pendulum_<damping>_validation_mrad       angle of both validation records, each from its own start
pendulum_<damping>_by_run_mrad           the same where the viscous part is that of the record
======================================== ==========================================================
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import numba as nb
import numpy as np
from scipy.io import loadmat
from scipy.optimize import least_squares
from scipy.signal import csd, welch

from bayesoleo.data import dataset_folder

Figures = dict[str, float]
#: Mass in kg, viscous friction in N s/m, Coulomb friction and offset in N (Janot, Gautier and
#: Brunot 2019).
PUBLISHED = (95.109, 203.50, 20.394, -3.165)
STEP = 1e-3
#: Velocities, m/s, between which the flexible force is linear; the records stay within 0.13 m/s.
KNOTS = np.array(
    [-0.3, -0.2, -0.14, -0.1, -0.06, -0.03, -0.01, -0.002, 0.0,
     0.002, 0.01, 0.03, 0.06, 0.1, 0.14, 0.2, 0.3]
)  # fmt: skip
BRFD = {
    "1_Hz_0.5_in": ("dataset-2_1Hz30lbtension0.5amplitude.json", 2.0, 1.0),
    "1_Hz_1_in": ("dataset-2_1Hz30lbtension1amplitude.json", 2.0, 1.0),
    "1_Hz_1.5_in": ("dataset-2_1Hz30lbtension1.5amplitude.json", 2.0, 1.0),
    "0.5_Hz_1_in": ("dataset-2_0.5Hz30lbtension1amplitude.json", 4.0, 2.0),
}


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def emps_record(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Position, m, and force, N, at 1 kHz."""
    found = loadmat(dataset_folder("emps") / name)
    return found["qm"].ravel(), found["vir"].ravel() * float(found["gtau"].ravel()[0])


def of_position(position: np.ndarray, force: np.ndarray) -> tuple[float, float, float]:
    """Force above 300 Hz, inertia above 300 Hz, and least rms above 20 Hz of a linear function.

    Second differences stand for the position: they are a linear function of it, and leave little
    for a window to leak. Few segments make the coherence too large, and the least rms too small.
    """
    acceleration = np.zeros_like(position)
    acceleration[1:-1] = np.diff(position, 2) / STEP**2
    settings = {"fs": 1 / STEP, "nperseg": 1024}
    frequency, of_force = welch(force, **settings)
    of_motion = welch(acceleration, **settings)[1]
    cross = csd(acceleration, force, **settings)[1]
    left = of_force - np.abs(cross) ** 2 / of_motion

    def above(least: float, power: np.ndarray) -> float:
        chosen = frequency >= least
        return float(np.sqrt(np.trapezoid(power[chosen], frequency[chosen])))

    return above(300.0, of_force), PUBLISHED[0] * above(300.0, of_motion), above(20.0, left)


@nb.njit(cache=False)
def moved(force, mass, velocities, friction, elastic, start):  # type: ignore[no-untyped-def]
    """Position of a mass under a force, by implicit steps of a third of a sample."""
    position = np.empty(force.size)
    place, speed, step = start, 0.0, STEP / 3
    for sample in range(force.size):
        position[sample] = place
        after = force[min(sample + 1, force.size - 1)]
        for part in range(3):
            drive = force[sample] + (after - force[sample]) * (part + 0.5) / 3
            drive -= place * (elastic[0] + place * (elastic[1] + place * elastic[2]))
            new = speed
            for _ in range(40):
                at = 0
                while at < velocities.size - 2 and new > velocities[at + 1]:
                    at += 1
                slope = (friction[at + 1] - friction[at]) / (velocities[at + 1] - velocities[at])
                error = mass * (new - speed) / step - drive
                error += friction[at] + slope * (new - velocities[at])
                change = -error / (mass / step + slope)
                # A corner is not jumped over, or Newton's steps would alternate about it.
                change = min(max(change, -0.002), 0.002)
                new += change
                if abs(change) < 1e-13:
                    break
            place += step * (speed + new) / 2
            speed = new
    return position


def simple(values: np.ndarray, force: np.ndarray, start: float) -> np.ndarray:
    """Position by mass, viscous friction, Coulomb friction of both directions and offset."""
    mass, viscous, forwards, backwards, offset = values
    coulomb = np.where(KNOTS > 0, forwards, backwards) * np.clip(KNOTS / 0.002, -1, 1)
    friction = viscous * KNOTS + coulomb + offset
    return np.asarray(moved(force, mass, KNOTS, friction, np.zeros(3), start))


def flexible(values: np.ndarray, force: np.ndarray, start: float) -> np.ndarray:
    """Position by mass, any force of velocity and a cubic force of position; scaled values."""
    mass, viscous, coulomb, offset = PUBLISHED
    friction = viscous * KNOTS + coulomb * np.clip(KNOTS / 0.002, -1, 1) + offset
    friction = friction + 5.0 * values[1:18]
    return np.asarray(
        moved(force, mass * (1 + values[0]), KNOTS, friction, 5.0 * values[18:], start)
    )


Model = Callable[[np.ndarray, np.ndarray, float], np.ndarray]


def fitted(model: Model, start: np.ndarray, position: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Values that leave the least square of the position's error."""

    def error(values: np.ndarray) -> np.ndarray:
        return 1e3 * (model(values, force, position[0]) - position)

    scale = np.maximum(np.abs(start), 1.0)
    for _ in range(2):
        start = least_squares(error, start, x_scale=scale, diff_step=1e-5, max_nfev=60).x
    return start


def emps() -> Figures:
    """Force by position, and position by force."""
    trajectory, pulses = emps_record("DATA_EMPS.mat"), emps_record("DATA_EMPS_PULSES.mat")

    def error(model: Model, values: np.ndarray, record: tuple[np.ndarray, np.ndarray]) -> float:
        position, force = record
        return 1e3 * rms(model(values, force, position[0]) - position)

    fast, inertia, least = of_position(*pulses)
    mass, viscous, coulomb, offset = PUBLISHED
    published = np.array([mass, viscous, coulomb, coulomb, offset])
    of_simple = fitted(simple, published, *trajectory)
    of_flexible = fitted(flexible, np.zeros(21), *trajectory)
    own = fitted(flexible, of_flexible, *pulses)
    return {
        "emps_pulses_force_above_300_Hz_N": fast,
        "emps_pulses_inertia_above_300_Hz_N": inertia,
        "emps_pulses_least_N": least,
        "emps_trajectory_least_N": of_position(*trajectory)[2],
        "emps_position_published_mm": error(simple, published, pulses),
        "emps_position_simple_fit_mm": error(simple, of_simple, trajectory),
        "emps_position_simple_pulses_mm": error(simple, of_simple, pulses),
        "emps_position_flexible_fit_mm": error(flexible, of_flexible, trajectory),
        "emps_position_flexible_pulses_mm": error(flexible, of_flexible, pulses),
        "emps_position_flexible_own_mm": error(flexible, own, pulses),
    }


@nb.njit(cache=False)
def stretched(displacement, limit):  # type: ignore[no-untyped-def]
    """Extension of a spring behind a slider that slips at a limit, over the second of two periods.

    The first one forgets where it began.
    """
    extension, found = 0.0, np.empty(displacement.size)
    for _ in range(2):
        for at in range(displacement.size):
            extension += displacement[at] - displacement[at - 1]
            extension = min(max(extension, -limit), limit)
            found[at] = extension
    return found


def band_force(
    values: np.ndarray, displacement: np.ndarray, velocity: np.ndarray, gap: bool
) -> np.ndarray:
    """Force of elastic Coulomb friction, with backlash in series where a gap is asked for."""
    forwards, backwards, rise, viscous, play, offset = values
    play = abs(play) if gap else 0.0
    extension = stretched(displacement, play + abs(rise))
    beyond = np.sign(extension) * np.maximum(np.abs(extension) - play, 0.0) / abs(rise)
    size = np.where(beyond > 0, forwards, backwards)
    return np.asarray(size * beyond + viscous * velocity + offset)


def brfd_run(file: Path, start: float, period: float) -> Figures:
    """Fits to one period, the average of three, that starts from several gaps and rises."""
    time, displacement, force = np.array(json.loads(file.read_text())["data"], float)[:, :3].T
    size = round(period * 1024)
    first = int(np.searchsorted(time, start))
    chosen = slice(first, first + 3 * size)
    displacement, force = (x[chosen].reshape(3, size).mean(0) for x in (displacement, force))
    spectrum = np.fft.rfft(displacement)
    spectrum[int(20 * period) :] = 0.0
    lines = 2j * np.pi * np.arange(spectrum.size) / period
    velocity, smooth = np.fft.irfft(lines * spectrum, size), np.fft.irfft(spectrum, size)
    fast = np.fft.rfft(force)
    fast[: int(20 * period) + 1] = 0.0
    found = {"above_20_Hz_kip": rms(np.fft.irfft(fast, size))}
    for name, gap in (("elastic_kip", False), ("backlash_kip", True)):

        def error(values: np.ndarray, gap: bool = gap) -> np.ndarray:
            return band_force(values, smooth, velocity, gap) - force

        level = np.quantile(np.abs(force), 0.8)
        starts = [
            [level, level, rise, 0.0, play, 0.0]
            for rise in (0.02, 0.1, 0.3)
            for play in ((0.03, 0.08, 0.2) if gap else (0.0,))
        ]
        fits = [least_squares(error, begin) for begin in starts]
        found[name] = min(rms(fit.fun) for fit in fits)
    return found


def brfd() -> Figures:
    """Every run, fitted to itself."""
    folder = dataset_folder("brfd")
    return {
        f"brfd_{run}_{key}": value
        for run, (file, start, period) in BRFD.items()
        for key, value in brfd_run(folder / file, start, period).items()
    }


@nb.njit(cache=False)
def swung(times, start, stiffness, velocities, force):  # type: ignore[no-untyped-def]
    """Angle of a pendulum that swings freely, by steps of a quarter of a sample (Runge-Kutta 4).

    The force of its velocity is linear between given velocities.
    """
    angle = np.empty(times.size)
    place, speed = start[0], start[1]
    slopes = np.diff(force) / np.diff(velocities)

    def pull(place: float, speed: float) -> float:
        at = min(max(np.searchsorted(velocities, speed) - 1, 0), slopes.size - 1)
        return -stiffness * np.sin(place) - force[at] - slopes[at] * (speed - velocities[at])

    for sample in range(times.size):
        angle[sample] = place
        if sample == times.size - 1:
            break
        step = (times[sample + 1] - times[sample]) / 4
        for _ in range(4):
            one = pull(place, speed)
            two = pull(place + step / 2 * speed, speed + step / 2 * one)
            three = pull(place + step / 2 * speed + step**2 / 4 * one, speed + step / 2 * two)
            four = pull(place + step * speed + step**2 / 2 * two, speed + step * three)
            place += step * speed + step**2 / 6 * (one + two + three)
            speed += step / 6 * (one + 2 * two + 2 * three + four)
    return angle


#: Velocities, rad/s, between which the force of a pendulum is linear.
FINE = np.sinh(np.linspace(-8.0, 8.0, 401)) / np.sinh(8.0) * 16.0


def viscous_swing(values: np.ndarray) -> np.ndarray:
    """Viscous damping."""
    return values[0] * FINE


def sharp_swing(values: np.ndarray) -> np.ndarray:
    """Viscous damping, Coulomb friction that turns within 0.05 rad/s, drag and a constant force."""
    viscous, coulomb, drag, constant = values
    return wide_swing(np.array([viscous, coulomb, np.log(0.05), drag, constant]))


def wide_swing(values: np.ndarray) -> np.ndarray:
    """The same with friction over any width, whose logarithm is given."""
    viscous, coulomb, width, drag, constant = values
    friction = coulomb * 2 / np.pi * np.arctan(FINE / np.exp(width))
    return viscous * FINE + friction + drag * FINE * np.abs(FINE) + constant


SWINGS = {
    "viscous": (viscous_swing, [0.056]),
    "sharp": (sharp_swing, [-0.02, 0.2, 0.006, -0.04]),
    "wide": (wide_swing, [-0.16, 1.3, np.log(3.7), 0.012, -0.04]),
}


def pendulum() -> Figures:
    """Each law of damping fitted to four records, and what two others say of it.

    All six are pieces of one decay, from 1.6 rad to 0.3: the others swing less far.
    """
    file = "SinglePendulumDataForParameterEstimation.mat"
    data = loadmat(dataset_folder("single_pendulum") / file)
    fitted, held = (
        [
            (time.ravel(), angles[0] - np.pi)
            for time, angles in zip(
                data[f"Time_{kind}"].ravel(), data[f"Y_{kind}"].ravel(), strict=True
            )
        ]
        for kind in ("id", "vad")
    )
    found: Figures = {}
    for name, (law, begin) in SWINGS.items():
        values, errors = fitted_swings(law, np.array([64.05, *begin]), fitted)
        found[f"pendulum_{name}_fit_mrad"] = 1e3 * rms(errors)
        for word, free in (("validation", 0), ("by_run", 1)):
            each = [one_swing(law, values, record, free) for record in held]
            found[f"pendulum_{name}_{word}_mrad"] = 1e3 * rms(np.concatenate(each))
    return found


def fitted_swings(
    law: Callable[[np.ndarray], np.ndarray],
    begin: np.ndarray,
    records: list[tuple[np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness and the law's values of several records with a start each, and what is left."""
    starts = [value for record in records for value in first_start(*record)]
    size = begin.size

    def error(values: np.ndarray) -> np.ndarray:
        force = law(values[1:size])
        return np.concatenate([
            swung(time, values[size + 2 * k : size + 2 * k + 2], values[0], FINE, force) - angle
            for k, (time, angle) in enumerate(records)
        ])  # fmt: skip

    fit = least_squares(error, [*begin, *starts], x_scale="jac", max_nfev=60)
    return fit.x[:size], fit.fun


def one_swing(
    law: Callable[[np.ndarray], np.ndarray],
    known: np.ndarray,
    record: tuple[np.ndarray, np.ndarray],
    free: int,
) -> np.ndarray:
    """What is left of a record by a known law, with its own start and, if free, viscous part."""
    time, angle = record

    def error(values: np.ndarray) -> np.ndarray:
        own = known.copy()
        own[1 : 1 + free] += values[2 : 2 + free]
        return np.asarray(swung(time, values[:2], own[0], FINE, law(own[1:])) - angle)

    begin = [*first_start(time, angle), *[0.0] * free]
    return np.asarray(least_squares(error, begin, x_scale="jac", max_nfev=60).fun)


def first_start(time: np.ndarray, angle: np.ndarray) -> tuple[float, float]:
    """Angle and velocity at the first sample, by a parabola through a tenth of a second."""
    few = time < time[0] + 0.1
    slope = np.polyfit(time[few] - time[0], angle[few], 2)
    return float(slope[2]), float(slope[1])


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one flat object")
    sets = {"emps": emps, "brfd": brfd, "pendulum": pendulum}
    parser.add_argument("--only", nargs="+", default=list(sets), choices=sets, metavar="SET")
    chosen = parser.parse_args()
    found: Figures = {}
    for name in chosen.only:
        found |= {key: round(value, 4) for key, value in sets[name]().items()}
    if chosen.json:
        print(json.dumps(found))
        return
    for key, value in found.items():
        print(f"{key:40} {value:8.3f}")


if __name__ == "__main__":
    main()
