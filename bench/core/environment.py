"""What ran: our own source, the libraries, the device. It goes into every record and decides what a resumed run may skip."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import inspect
import platform
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any

DISTRIBUTION = "feature-privacy-bench"
# Without `suites`, which say what is run, and have no part in how.
PACKAGES = ("attacks", "bench", "defenses", "leaderboard", "metrics")
LIBRARIES = ("numpy", "opencv-python-headless", "pillow", "poselib", "pycolmap", "scikit-image", "torch")


def describe(plugins: Iterable[object]) -> dict[str, Any]:
    """The environment as records hold it. `plugins` are those that take part; their files count as source."""
    return {"version": version(DISTRIBUTION), "source": source_digest(plugins), **computing()}


def computing() -> dict[str, Any]:
    """All of the environment that numbers may depend on beside our own source."""
    import torch

    from bench.core.device import pick_device, pick_dtype

    device = pick_device()
    return {
        "python": platform.python_version(),
        **libraries(),
        "machine": f"{platform.system()} {platform.machine()}",
        "device": device.type,
        "dtype": str(pick_dtype(device)).removeprefix("torch."),
        "threads": torch.get_num_threads(),
    }


def libraries() -> dict[str, str]:
    """The versions of those libraries that results depend on."""
    return {library: version(library) for library in LIBRARIES}


def source_digest(plugins: Iterable[object]) -> str:
    """SHA-256 over every Python file of our packages, and of plugins that come from elsewhere."""
    files = {f"{package}/{path.relative_to(root).as_posix()}": path for package, root in _roots() for path in root.rglob("*.py")}
    for plugin in plugins:
        module = type(plugin).__module__
        if module.partition(".")[0] not in PACKAGES:
            with contextlib.suppress(TypeError, OSError):  # a plugin typed into a session has no file
                files[module] = Path(inspect.getfile(type(plugin)))
    digest = hashlib.sha256()
    for name in sorted(files):
        digest.update(f"{name} {hashlib.sha256(files[name].read_bytes()).hexdigest()}\n".encode())
    return "sha256:" + digest.hexdigest()


def file_digest(plugin: object) -> str | None:
    """SHA-256 of the file that a plugin is in, if it is in one. It tells whose code changed, but not that of what it calls."""
    with contextlib.suppress(TypeError, OSError):
        return "sha256:" + hashlib.sha256(Path(inspect.getfile(type(plugin))).read_bytes()).hexdigest()
    return None


def _roots() -> Iterable[tuple[str, Path]]:
    for package in PACKAGES:
        spec = importlib.util.find_spec(package)
        for place in (spec.submodule_search_locations or ()) if spec else ():
            yield package, Path(place)
