"""The regression functions of the NIST StRD nonlinear sets, from the headers of their files."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np


def exponential_rise(x, b):
    return b[0] * (1 - np.exp(-b[1] * x))


def decay_over_line(x, b):
    return np.exp(-b[0] * x) / (b[1] + b[2] * x)


def two_peaks(x, b):
    first = b[2] * np.exp(-((x - b[3]) ** 2) / b[4] ** 2)
    second = b[5] * np.exp(-((x - b[6]) ** 2) / b[7] ** 2)
    return b[0] * np.exp(-b[1] * x) + first + second


def cubic_over_cubic(x, b):
    top = b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3
    return top / (1 + b[4] * x + b[5] * x**2 + b[6] * x**3)


def three_decays(x, b):
    return sum(b[i] * np.exp(-b[i + 1] * x) for i in (0, 2, 4))


def seasons(x, b):
    value = b[0]
    for cosine, sine, period in ((b[1], b[2], 12.0), (b[4], b[5], b[3]), (b[7], b[8], b[6])):
        angle = 2 * np.pi * x / period
        value = value + cosine * np.cos(angle) + sine * np.sin(angle)
    return value


FUNCTIONS = {
    "Bennett5": lambda x, b: b[0] * (b[1] + x) ** (-1 / b[2]),
    "BoxBOD": exponential_rise,
    "Chwirut1": decay_over_line,
    "Chwirut2": decay_over_line,
    "DanWood": lambda x, b: b[0] * x ** b[1],
    "ENSO": seasons,
    "Eckerle4": lambda x, b: b[0] / b[1] * np.exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "Gauss1": two_peaks,
    "Gauss2": two_peaks,
    "Gauss3": two_peaks,
    "Hahn1": cubic_over_cubic,
    "Kirby2": lambda x, b: (b[0] + b[1] * x + b[2] * x**2) / (1 + b[3] * x + b[4] * x**2),
    "Lanczos1": three_decays,
    "Lanczos2": three_decays,
    "Lanczos3": three_decays,
    "MGH09": lambda x, b: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "MGH10": lambda x, b: b[0] * np.exp(b[1] / (x + b[2])),
    "MGH17": lambda x, b: b[0] + b[1] * np.exp(-x * b[3]) + b[2] * np.exp(-x * b[4]),
    "Misra1a": exponential_rise,
    "Misra1b": lambda x, b: b[0] * (1 - (1 + b[1] * x / 2) ** -2),
    "Misra1c": lambda x, b: b[0] * (1 - (1 + 2 * b[1] * x) ** -0.5),
    "Misra1d": lambda x, b: b[0] * b[1] * x / (1 + b[1] * x),
    "Nelson": lambda x, b: b[0] - b[1] * x[0] * np.exp(-b[2] * x[1]),
    "Rat42": lambda x, b: b[0] / (1 + np.exp(b[1] - b[2] * x)),
    "Rat43": lambda x, b: b[0] / (1 + np.exp(b[1] - b[2] * x)) ** (1 / b[3]),
    "Roszman1": lambda x, b: b[0] - b[1] * x - np.arctan(b[2] / (x - b[3])) / np.pi,
    "Thurber": cubic_over_cubic,
}


def complex_step(function):
    """Exact derivatives of an analytic function: the imaginary part has no rounding to cancel."""

    def jacobian(x, theta):
        step = 1e-30
        columns = []
        for index in range(theta.size):
            shifted = theta.astype(complex)
            shifted[index] += 1j * step
            columns.append(np.imag(function(x.astype(float), shifted)) / step)
        return np.column_stack(columns)

    return jacobian


@dataclass(frozen=True)
class Certified:
    """One set: data, two starts, certified parameters and standard deviations."""

    x: np.ndarray
    y: np.ndarray
    starts: np.ndarray
    theta: np.ndarray
    sd: np.ndarray


def read(path):
    """Read a ``.dat`` file of the NIST StRD."""
    lines = path.read_text(encoding="ascii").splitlines()
    rows = [re.match(r"\s*b\d+ =\s*(.*)", line) for line in lines]
    table = np.array([[float(word) for word in row[1].split()] for row in rows if row])
    first = max(i for i, line in enumerate(lines) if line.startswith("Data:")) + 1
    # Extended precision, where the machine has it: Lanczos1 fits to the 14th digit of its data, and
    # its residuals would be the rounding of the decimals to double.
    words = [line.split() for line in lines[first:] if line.strip()]
    data = np.array([[np.longdouble(word) for word in line] for line in words])
    y, x = data[:, 0], data[:, 1:].T
    if path.stem == "Nelson":
        y = np.log(y)
    else:
        x = x[0]
    return Certified(x, y, table[:, :2].T, table[:, 2], table[:, 3])
