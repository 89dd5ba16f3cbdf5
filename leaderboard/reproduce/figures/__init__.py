"""The paper's figures and some of ours, one file each, which sets `DRAWING`."""

from __future__ import annotations

import importlib
import pkgutil

from leaderboard.reproduce.drawing import Drawing


def load_figures() -> tuple[Drawing, ...]:
    """Return all figures."""
    modules = [importlib.import_module(f"{__name__}.{module.name}") for module in pkgutil.iter_modules(__path__)]
    return tuple(module.DRAWING for module in modules)
