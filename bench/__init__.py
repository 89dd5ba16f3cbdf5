"""Privacy benchmark for local image features: reconstruction by an attacker, and utility for a server.

```python
import bench
from attacks.dia import DIA
from defenses.ldp import LDP

records = bench.run(defenses=[LDP(epsilon=10)], attacks=[DIA()], images="photos")
```
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bench.mechanisms.protection import protect
    from bench.runner.execute import run
    from bench.runner.records import load_records

    __version__: str

__all__ = ["__version__", "load_records", "protect", "run"]

# Imported at first use, so that `import bench` and `bench --help` are fast.
_HOMES = {"protect": "bench.mechanisms.protection", "load_records": "bench.runner.records", "run": "bench.runner.execute"}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("feature-privacy-bench")
    if name not in _HOMES:
        raise AttributeError(f"module 'bench' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
