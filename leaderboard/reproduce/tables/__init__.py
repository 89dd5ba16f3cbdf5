"""The paper's tables, one file each, which sets `TABLE`."""

from __future__ import annotations

import importlib
import pkgutil

from leaderboard.reproduce.study import Table


def load_tables() -> dict[str, Table]:
    """Return all tables by name."""
    modules = [importlib.import_module(f"{__name__}.{module.name}") for module in pkgutil.iter_modules(__path__)]
    tables: list[Table] = [module.TABLE for module in modules]
    return {table.name: table for table in tables}
