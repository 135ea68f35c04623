"""Prediction of measured runs by a model: periodic and transient motions, with sensitivities."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
