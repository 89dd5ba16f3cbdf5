"""Network file: half-precision safetensors, whose metadata describe the releases of the training."""

from __future__ import annotations

import functools
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.core.errors import UserError
from bench.formats import tensor_file
from bench.formats.network_file import NetworkFile, build_module

if TYPE_CHECKING:
    from bench.context.network import ContextModel

KIND = "surroundings-network"


@dataclass(frozen=True, eq=False)
class Network(NetworkFile):
    """A trained network, ready for inference."""

    @cached_property
    def module(self) -> ContextModel:
        """The network itself, built at first use.

        Raises
        ------
        UserError
            if its tensors do not match its metadata.
        """
        import torch

        from bench.context.network import ContextModel, Shape
        from bench.core.device import pick_device

        module = build_module(self.path, lambda: ContextModel(Shape(**self.meta["shape"])))
        try:
            module.load_state_dict({name: torch.from_numpy(array.astype(np.float32)) for name, array in self.arrays.items()})
        except RuntimeError as error:
            raise UserError(f"{self.path}: tensors do not match the metadata: {error}") from error
        return module.eval().to(pick_device())


def save(path: Path, module: ContextModel, meta: dict[str, Any]) -> str:
    """Write the weights, in half precision unless a value overflows, and return the digest of the file."""
    arrays = {name: tensor_file.to_half(value.cpu().numpy()) for name, value in module.state_dict().items()}
    return tensor_file.save(path, KIND, arrays, {**meta, "shape": asdict(module.shape)})


def load(path: Path) -> Network:
    """Read and verify a network; an unchanged file is read once.

    Raises
    ------
    UserError
        if the file is damaged.
    """
    status = path.stat() if path.is_file() else None
    return _load(path, status and (status.st_mtime_ns, status.st_size))


@functools.lru_cache(maxsize=4)
def _load(path: Path, version: object) -> Network:
    return Network(path, *tensor_file.load(path, KIND))
