"""Memory of a batch with sensitivities, and the time until a new model is solved, each in a process
of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile

NEW_MODEL = """
import time
from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.prediction._simulate import RunPlan, motion, simulate_run
begin, used = time.perf_counter(), time.process_time()
model = Model("new", inputs={"force": "N"}, dofs={"q": Dof("m")},
    parameters={"damping": Parameter(0.3, sd=0.1), "cubic": Parameter(0.7, sd=0.1)},
    equations={"q": {"all": "ddot(q) + damping*dot(q) + q + cubic*q**3 - force"}},
    outputs={"displacement": Output("q", "m")})
simulate_run(model, RunPlan("a", 0.2, {"force": motion(0.1, [1.0])}), backend="numba")
print(time.perf_counter() - begin, time.process_time() - used)
"""

IMPORT = "import time; t = time.perf_counter(); import bayesoleo; print(time.perf_counter() - t)"

# The highest resident size is reset before each batch, so that what was loaded before is only what
# it still holds.
MEMORY = """
import json, sys
from pathlib import Path
import numpy as np
from cases import batch, campaign
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.systems import system

def megabytes(name):
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(name))

def highest(vectors):
    Path("/proc/self/clear_refs").write_text("5")
    for first in range(0, vectors, problem.lanes):
        part = theta[first : min(first + problem.lanes, vectors)]
        data = [np.broadcast_to(column, (len(part), column.size)) for column in problem.data]
        found = problem.normal_equations(part, data)
        failures.append(int(np.count_nonzero(found.status)))
    return megabytes("VmHWM")

predictor = Predictor(system("f16n2d1"), campaign(), steps=800, scheme="thesis")
problem, failures = CampaignProblem(predictor), []
theta = batch(predictor, 256)
highest(1)
before, counts = megabytes("VmRSS"), json.loads(sys.argv[1])
found = {count: highest(count) for count in counts}
print(json.dumps({"before": before, "failures": sum(failures)} | found))
"""

#: Parameter vectors of the batches whose memory is measured, one after the other.
VECTORS = (32, 64, 128, 256)


def _run(code: str, *arguments: str, environment: dict[str, str] | None = None) -> str:
    """Last line that a process prints which runs ``code`` in this folder."""
    here = os.path.dirname(os.path.abspath(__file__))
    known = os.environ | (environment or {})
    known["PYTHONPATH"] = os.pathsep.join(filter(None, [here, known.get("PYTHONPATH")]))
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, env=known, check=True, capture_output=True, text=True)
    return done.stdout.splitlines()[-1]


def new_model() -> dict[str, float]:
    """Declaration to first solve in two processes with one cache, and the import, s; of both
    solves also CPU time."""

    def solved(folder: str) -> list[float]:
        return [float(x) for x in _run(NEW_MODEL, environment={"BAYESOLEO_CACHE": folder}).split()]

    with tempfile.TemporaryDirectory() as folder:
        first = solved(folder)
        again = [solved(folder) for _ in range(3)]
    return {
        "new_model_s": first[0],
        "new_model_cpu_s": first[1],
        "new_model_cached_s": min(wall for wall, _ in again),
        "new_model_cached_cpu_s": min(used for _, used in again),
        "import_s": min(float(_run(IMPORT)) for _ in range(3)),
    }


def peak_memory() -> dict[str, float]:
    """Highest resident size, MB, while all runs are solved with sensitivities for so many vectors;
    where the system does not tell, nothing."""
    if not os.path.exists("/proc/self/clear_refs"):
        return {}
    found = json.loads(_run(MEMORY, json.dumps(VECTORS)))
    least, most = (found[str(count)] for count in (VECTORS[0], VECTORS[-1]))
    return {
        "peak_memory_mb": least,
        "peak_memory_solves_mb": least - found["before"],
        **{f"peak_memory_{count}_mb": found[str(count)] for count in VECTORS[1:]},
        "peak_memory_growth": most / least,
        "peak_memory_failures": found["failures"],
    }
