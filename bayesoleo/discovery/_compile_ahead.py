"""Compilation in a process of its own of what a search needs later, where nothing is compiled yet.

The search itself begins with Newton's iteration, which it compiles; meanwhile the rest is made in
the order in which it is needed.
"""

from __future__ import annotations


def compile_ahead() -> None:
    """Compile the elimination of sensitivities, then the evidence of structures."""
    # Each is imported once the one before is compiled: libraries take seconds to load.
    from bayesoleo.solvers._collocation import compile_elimination

    compile_elimination()
    from bayesoleo.discovery._structure_evidence import compile_evidence

    compile_evidence()
