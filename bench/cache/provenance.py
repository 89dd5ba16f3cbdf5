"""Hashes of the source of modules and of their imports, for cache keys.

Records hold `environment.hash_source`, the hash of all our source. With that hash as a key, a new metric would invalidate every
entry.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.util
from collections.abc import Iterator
from importlib.abc import InspectLoader

from bench.core.environment import PACKAGES


@functools.cache
def hash_modules(*modules: str) -> str:
    """Return the SHA-256 of the source of `modules` and of all that they import from our packages and from their own."""
    ours = {*PACKAGES, *(module.partition(".")[0] for module in modules)}
    texts: dict[str, str] = {}
    waiting = list(modules)
    while waiting:
        module = waiting.pop()
        if module in texts or module.partition(".")[0] not in ours or (text := _read_source(module)) is None:
            continue
        texts[module] = text
        waiting += _list_imports(module, text)
    digest = hashlib.sha256()
    for module in sorted(texts):
        digest.update(f"{module} {hashlib.sha256(texts[module].encode()).hexdigest()}\n".encode())
    return "sha256:" + digest.hexdigest()


@functools.cache
def _read_source(module: str) -> str | None:
    """Return the source, None if the module does not exist or has none."""
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    return spec.loader.get_source(module) if spec and isinstance(spec.loader, InspectLoader) else None


def _list_imports(module: str, text: str) -> Iterator[str]:
    """Yield the names of modules that may be imported at any time, without those under TYPE_CHECKING."""
    package = module if _is_package(module) else module.rpartition(".")[0]
    waiting: list[ast.AST] = [ast.parse(text)]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            waiting += node.orelse
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)
        waiting += ast.iter_child_nodes(node)


def _is_package(module: str) -> bool:
    spec = importlib.util.find_spec(module)
    return spec is not None and spec.submodule_search_locations is not None
