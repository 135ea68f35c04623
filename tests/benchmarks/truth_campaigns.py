"""Campaigns that lack nothing: is that what the loop says, and is the error as large as expected?

Three hundred campaigns of the six kinds of :mod:`truth_systems`, an eighth of them transients. In
half of them the fitted runs say little of what the held-out runs depend on: slow or small ones are
fitted, fast or large ones held out. Every verdict but "nothing missing" is false. The squared ratio
of the repeating error to what noise and the parameters' posterior let expect is one on average.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from truth_systems import KINDS, Made, Plan, make

from bayesoleo import _schema as schema
from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import prepare
from bayesoleo.discovery._loop import ClosedLoop, close_loop

#: Campaigns of each kind.
EACH = 50


@dataclass(frozen=True)
class Case:
    """One campaign and what came of it."""

    kind: str
    seed: int
    weak: bool
    transient: bool
    loop: ClosedLoop
    seconds: float

    @property
    def false(self) -> bool:
        """Whether the verdict is another than the truth."""
        return self.loop.verdict != schema.NOTHING_MISSING

    def __str__(self) -> str:
        what = ", ".join(self.loop.effects) or "no effect"
        weak, kind = "weak" if self.weak else "plain", "transient" if self.transient else "periodic"
        table = {
            role: {o: round(v["ratio_to_expected"], 3) for o, v in by.items()}
            for role, by in self.loop.final.by_role.items()
        }
        return (
            f"{self.kind} {self.seed} ({weak}, {kind}, {self.seconds:.1f} s): {self.loop.verdict},"
            f" {what}; {self.loop.rounds[-1].reason[:90]} {table}"
        )


def close(made: Made, **settings: Any) -> ClosedLoop:
    """Close the loop on a campaign, without a posterior."""
    task = prepare(made.campaign, made.model, Settings(jobs=1, **settings))
    return close_loop(task.assembly, task.roles, task.settings.numerics, seed=0)


def run(kind: str, seed: int) -> Case:
    """One campaign; its seed says which it is."""
    weak, transient = seed % 2 == 1, seed % 16 in (2, 3)
    begin = time.perf_counter()
    loop = close(make(kind, seed, plan=Plan(weak=weak, transient=transient)))
    return Case(kind, seed, weak, transient, loop, time.perf_counter() - begin)


def figures(fraction: float = 1.0, say: Callable[[str], object] = print) -> dict[str, float]:
    """False verdicts, and the pooled ratio to what is expected.

    Parameters
    ----------
    fraction : float
        Part of the campaigns, the first ones of each kind.
    say : callable
        Told of each false verdict.
    """
    cases = []
    for seed in range(max(1, round(fraction * EACH))):
        for kind in KINDS:
            cases.append(run(kind, seed))
            if cases[-1].false:
                say(str(cases[-1]))
    false = [case for case in cases if case.false]
    entries = {
        role: [e for c in cases for e in getattr(c.loop.first, name).entries]
        for role, name in (("fit", "fit_errors"), ("hold_out", "hold_errors"))
    }

    def pooled(found: list[Any]) -> float:
        return float(np.sqrt(np.mean([e.ratio_to_expected**2 for e in found])))

    found = {
        "campaigns": float(len(cases)),
        "false_verdicts": len(false) / len(cases),
        "false_verdicts_weak": float(np.mean([c.false for c in cases if c.weak] or [0.0])),
        "effects_added": float(sum(bool(case.loop.effects) for case in cases)),
        "ratio_to_expected": pooled(entries["fit"] + entries["hold_out"]),
        "ratio_to_noise_worst": max(e.ratio for e in entries["hold_out"]),
        "ratio_to_expected_worst": max(e.ratio_to_expected for e in entries["hold_out"]),
        "campaign_slowest_s": max(case.seconds for case in cases),
    }
    return found | {f"ratio_to_expected_{role}": pooled(part) for role, part in entries.items()}
