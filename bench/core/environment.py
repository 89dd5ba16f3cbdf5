"""The environment of a run: our own source, the libraries, the device.

Every record holds it. A resumed run skips a record only if its environment is the same.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import inspect
import platform
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

DISTRIBUTION = "feature-privacy-bench"
# `suites` is left out: a suite selects experiments and does not change their results.
PACKAGES = ("attacks", "bench", "defenses", "leaderboard", "metrics")
LIBRARIES = ("numpy", "opencv-python-headless", "pillow", "poselib", "pycolmap", "scikit-image", "torch")
EXTRACTOR_LIBRARIES = ("kornia",)  # optional; records do not hold their versions


def describe(plugins: Iterable[object]) -> dict[str, Any]:
    """Return the environment for records. The files of `plugins` count as source."""
    return {"version": version(DISTRIBUTION), "source": hash_source(plugins), **describe_platform()}


def describe_platform() -> dict[str, Any]:
    """Return the parts of the environment besides our own source: Python, libraries, machine, device, threads."""
    import torch

    from bench.core.device import pick_device, pick_dtype

    device = pick_device()
    return {
        "python": platform.python_version(),
        **list_library_versions(),
        "machine": f"{platform.system()} {platform.machine()}",
        "device": device.type,
        "dtype": str(pick_dtype(device)).removeprefix("torch."),
        "threads": torch.get_num_threads(),
    }


def list_library_versions() -> dict[str, str]:
    """Return the versions of the libraries that results depend on."""
    return {library: version(library) for library in LIBRARIES}


def is_installed(distribution: str) -> bool:
    """Return whether a distribution is installed, without importing it."""
    try:
        version(distribution)
    except PackageNotFoundError:
        return False
    return True


def list_extractor_library_versions() -> dict[str, str]:
    """Return the versions of the installed libraries that features depend on, for cache keys."""
    installed = (library for library in EXTRACTOR_LIBRARIES if is_installed(library))
    return list_library_versions() | {library: version(library) for library in installed}


def hash_source(plugins: Iterable[object]) -> str:
    """Return the SHA-256 of every Python file of our packages and of external plugins."""
    files = {
        f"{package}/{path.relative_to(root).as_posix()}": path
        for package, root in _find_packages()
        for path in root.rglob("*.py")
    }
    for plugin in plugins:
        module = type(plugin).__module__
        if module.partition(".")[0] not in PACKAGES:
            with contextlib.suppress(TypeError, OSError):  # a plugin defined in an interactive session has no file
                files[module] = Path(inspect.getfile(type(plugin)))
    digest = hashlib.sha256()
    for name in sorted(files):
        digest.update(f"{name} {hashlib.sha256(files[name].read_bytes()).hexdigest()}\n".encode())
    return "sha256:" + digest.hexdigest()


def hash_plugin_file(plugin: object) -> str | None:
    """Return the SHA-256 of a plugin's file, None if it has no file. The code that the plugin calls is not covered."""
    with contextlib.suppress(TypeError, OSError):
        return "sha256:" + hashlib.sha256(Path(inspect.getfile(type(plugin))).read_bytes()).hexdigest()
    return None


def _find_packages() -> Iterable[tuple[str, Path]]:
    for package in PACKAGES:
        spec = importlib.util.find_spec(package)
        for folder in (spec.submodule_search_locations or ()) if spec else ():
            yield package, Path(folder)
