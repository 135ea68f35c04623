"""Other ways to find what a model lacks, beside the closed loop, on the same held-out runs.

Run as ``python tests/benchmarks/other_ways.py [--json] [CAMPAIGN …]`` with ``BAYESOLEO_DATA`` set;
``pysindy`` and ``scikit-learn`` come with the group ``bench``, and a way that is not installed is
left out. The work is that of the gallery's page, ``studies/other_ways.py``.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "studies"))

from other_ways import main

if __name__ == "__main__":
    main()
