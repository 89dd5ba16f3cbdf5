"""Networks on disk: half-precision safetensors whose metadata say what releases they were trained for."""

from __future__ import annotations

import functools
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from bench.api import Between, Defense, Extractor, OneOf
from bench.codebook.public import Public
from bench.core.device import pick_device
from bench.core.errors import UserError
from bench.formats import tensor_file
from bench.inversion.network import Inverter, Shape
from bench.registry import fields, spec

KIND = "inversion-network"
TOLD = ("defense", "encoding", "extractor", "serves", "shape", "slots")  # what metadata must say for a network to be used
LEG = ("start", "crops", "batch", "photographs", "rate", "symmetries")  # what is told of each training of several


@dataclass(frozen=True, eq=False)
class Network:
    """A trained network, ready to paint."""

    module: Inverter
    meta: dict[str, Any]
    digest: str

    @property
    def served(self) -> dict[str, Between | OneOf]:
        return {field: _setting(text) for field, text in self.meta["serves"].items()}


def save(path: Path, module: nn.Module, shape: Shape, meta: dict[str, Any]) -> str:
    """Write the weights in half precision, but for tensors that do not fit into it, and return the file's digest."""
    arrays = {
        name: tensor_file.halved(value.detach().cpu().numpy())
        for name, value in module.state_dict().items()
        if value.is_floating_point()
    }
    return tensor_file.save(path, KIND, arrays, {**meta, "shape": asdict(shape)})


def load(path: Path) -> Network:
    """Read a network and verify it; once for a file that does not change.

    Raises
    ------
    UserError
        if the file is damaged, says too little of itself, or its tensors are not those of the network that it describes, or not
        finite.
    """
    status = path.stat() if path.is_file() else None
    return _load(path, status and (status.st_mtime_ns, status.st_size))


@functools.lru_cache(maxsize=8)
def _load(path: Path, version: object) -> Network:
    arrays, meta, digest = tensor_file.load(path, KIND)
    missing = [what for what in TOLD if what not in meta]
    if missing:
        raise UserError(f"{path}: its metadata do not say {', '.join(missing)}; `bench train` makes a network whose do")
    wrong = sorted({str(array.dtype) for array in arrays.values()} - {"float16", "float32"})
    if wrong:
        raise UserError(f"{path}: weights are {', '.join(wrong)}, expected float16 or float32")
    shape = Shape(**{**meta["shape"], "widths": tuple(meta["shape"]["widths"])})
    module = Inverter(shape)
    for name, value in module.state_dict().items():
        if not value.is_floating_point():
            continue  # batch norm's counter of batches, which only training uses
        if name not in arrays or arrays[name].shape != tuple(value.shape):
            found = arrays[name].shape if name in arrays else "nothing"
            raise UserError(f"{path}: tensor {name} has shape {found}, expected {tuple(value.shape)}")
        if not np.isfinite(arrays[name]).all():
            raise UserError(f"{path}: tensor {name} has numbers that are not finite; train the network anew")
        value.copy_(torch.from_numpy(arrays[name].astype(np.float32)))
    module.eval().to(pick_device(), memory_format=torch.channels_last)  # type: ignore[call-overload]
    return Network(module, meta, digest)


@torch.no_grad()
def start_from(fresh: Inverter, trained: Inverter, candidates: int) -> None:
    """Start a network from one that read the same kind of release, or from one that paints raw descriptors.

    From the latter, its first layer reads the first `candidates` slots as descriptors (a set's words; of a subspace the point
    nearest to zero), with weights shared out so that the sum of independent ones keeps its size, and nothing of the other slots
    and the condition. Everything else is taken over as it is.

    Raises
    ------
    UserError
        if the two networks have other sizes, or `trained` reads neither such releases nor raw descriptors.
    """
    first = "embed.0.weight"
    old, new = trained.state_dict(), fresh.state_dict()
    if any(old[name].shape != value.shape for name, value in new.items() if name != first):
        raise UserError("--start: that network has other sizes")
    for name, value in new.items():
        if value.shape == old[name].shape:
            value.copy_(old[name])
    if new[first].shape == old[first].shape:
        return
    places = old[first].shape[1] - 2  # columns of the descriptor; two more say where in its cell the keypoint lies
    slots = (new[first].shape[1] - 2) // max(1, places)
    if trained.shape.candidates or not places or slots < candidates:
        raise UserError("--start: that network reads other releases")
    new[first].zero_()
    new[first][:, : candidates * places] = (old[first][:, :places] / candidates**0.5).repeat(1, candidates)
    new[first][:, slots * places : slots * places + 2] = old[first][:, places:]


def legs(meta: dict[str, Any]) -> list[dict[str, Any]]:
    """The trainings that made a network, each from where the one before ended, the first one first, as its metadata say them."""
    return [*meta.get("earlier", []), {what: meta.get(what) for what in LEG}]


def describe(defense: Defense, served: dict[str, Between | OneOf], extractor: Extractor, public: Public) -> dict[str, Any]:
    """What a network is trained for, as its metadata say it."""
    return {
        "defense": {field: value for field, value in spec.configuration(defense, public).items() if field not in served},
        "serves": {field: _text(setting) for field, setting in served.items()},
        "extractor": spec.configuration(extractor, public),
    }


def misfit(meta: dict[str, Any], defense: Defense, extractor: Extractor, public: Public) -> str | None:
    """Why a network was not trained for the releases of `defense`; None if it was."""
    if meta["defense"]["name"] != defense.name():
        return f"trained for {meta['defense']['name']}"
    have = spec.configuration(defense, public)
    for field, text in meta["serves"].items():
        if getattr(defense, field) not in _setting(text):
            return f"trained for {field} {_setting(text)}, not {getattr(defense, field)}"
    trained = fields.defaults(type(defense)) | meta["defense"]  # a field that is newer than the network had its default
    for field in sorted((have.keys() | meta["defense"].keys()) - meta["serves"].keys()):
        if have.get(field) != trained.get(field):
            return f"trained for {field} {trained.get(field)}, not {have.get(field)}"
    return other_features(meta, extractor, public)


def other_features(meta: dict[str, Any], extractor: Extractor, public: Public) -> str | None:
    """Why a network was not trained for the features of `extractor`; None if it was."""
    features = spec.configuration(extractor, public)
    for field in sorted(meta["extractor"].keys() | features.keys()):
        if meta["extractor"].get(field) != features.get(field):
            wanted, got = meta["extractor"].get(field), features.get(field)
            return f"trained for features with {field} {wanted}, not {got}"
    return None


def _text(setting: Between | OneOf) -> dict[str, list[Any]]:
    return {"between": [setting.low, setting.high]} if isinstance(setting, Between) else {"one_of": list(setting.values)}


def _setting(text: dict[str, list[Any]]) -> Between | OneOf:
    return Between(*text["between"]) if "between" in text else OneOf(tuple(text["one_of"]))
