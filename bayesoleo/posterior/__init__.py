"""Posterior density of parameters and variances: its sampler, approximations and diagnostics."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
