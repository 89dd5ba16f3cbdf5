"""The paper's tables, one file each, which sets `TABLE`."""

from __future__ import annotations

import importlib
import pkgutil

from leaderboard.reproduce.study import Table


def everything() -> dict[str, Table]:
    """All tables by the name that the command calls them."""
    modules = [importlib.import_module(f"{__name__}.{found.name}") for found in pkgutil.iter_modules(__path__)]
    tables: list[Table] = [module.TABLE for module in modules]
    return {table.name: table for table in tables}
