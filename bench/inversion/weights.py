"""Network files: half-precision safetensors, whose metadata describe the releases of the training."""

from __future__ import annotations

import functools
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from bench.api import Defense, Extractor
from bench.codebook.public import ASSETS, Public
from bench.core.errors import UserError
from bench.formats import tensor_file
from bench.formats.network_file import NetworkFile, build_module
from bench.images.views import LIMIT
from bench.inversion.encoding import Encoding
from bench.registry import fields, spec
from bench.registry.composed import list_parts
from bench.settings import Between, OneOf
from bench.types import Floats

if TYPE_CHECKING:
    from torch import nn

    from bench.inversion.data import Target
    from bench.inversion.kinds import AnyNetwork
    from bench.inversion.network import GridNetwork, Shape

KIND = "inversion-network"
# File names of the shipped networks that reconstruct the photograph from points.
SHIPPED = {"shipped": "inversion-*.safetensors"}
DEFAULT_EXTRACTOR = "sift"  # of `bench train`
REQUIRED_METADATA = ("defense", "encoding", "extractor", "serves", "shape", "slots")  # metadata for inference
MODELS = {None: "reconstructs the photograph", "flow": "samples photographs"}  # metadata `model` -> what the network does
STAGE_METADATA = ("start", "crops", "batch", "photographs", "rate", "symmetries")  # metadata of each training stage


@dataclass(frozen=True, eq=False)
class Network(NetworkFile):
    """A trained network, ready for inference."""

    @cached_property
    def module(self) -> AnyNetwork:
        """The network itself, built at first use.

        Raises
        ------
        UserError
            if its tensors do not match its metadata.
        """
        import torch

        from bench.core.device import pick_device
        from bench.inversion.kinds import build_network
        from bench.inversion.network import Shape

        shape, model = self.meta["shape"], self.meta.get("model")
        module = build_module(self.path, lambda: build_network(Shape(**{**shape, "widths": tuple(shape["widths"])}), model))
        for name, value in module.state_dict().items():
            if not value.is_floating_point():
                continue  # batch norm's counter of batches, used in training only
            if name not in self.arrays or self.arrays[name].shape != tuple(value.shape):
                actual = self.arrays[name].shape if name in self.arrays else "nothing"
                raise UserError(f"{self.path}: tensor {name} has shape {actual}, expected {tuple(value.shape)}")
            value.copy_(torch.from_numpy(self.arrays[name].astype(np.float32)))
        module.eval().to(pick_device(), memory_format=torch.channels_last)  # type: ignore[call-overload]
        return module

    def encode_settings(self, defense: Defense, public: Public) -> Floats:
        """Return the input that describes the settings of a compatible defense. -> (C,)"""
        from bench.inversion.encoding import encode_settings

        targets = _list_targets(self.meta)
        number = next(i for i, target in enumerate(targets) if _explain_other_releases(target, defense, public) is None)
        return encode_settings(defense, number, [_decode_settings(target) for target in targets])


def save(path: Path, module: nn.Module, shape: Shape, meta: dict[str, Any]) -> str:
    """Write the weights, in half precision unless a value overflows, and return the digest of the file."""
    arrays = {
        name: tensor_file.to_half(value.detach().cpu().numpy())
        for name, value in module.state_dict().items()
        if value.is_floating_point()
    }
    return tensor_file.save(path, KIND, arrays, {**meta, "shape": asdict(shape)})


def load(path: Path) -> Network:
    """Read and verify a network; an unchanged file is read once.

    Raises
    ------
    UserError
        if the file is damaged, lacks metadata, or has tensors that are not finite.
    """
    status = path.stat() if path.is_file() else None
    return _load(path, status and (status.st_mtime_ns, status.st_size))


@functools.lru_cache(maxsize=32)  # more than there are shipped files
def _load(path: Path, version: object) -> Network:
    arrays, meta, digest = tensor_file.load(path, KIND)
    missing = [key for key in REQUIRED_METADATA if key not in meta]
    if missing:
        raise UserError(f"{path}: metadata lack {', '.join(missing)}; train the network anew with `bench train`")
    if not _are_metadata(meta):
        raise UserError(f"{path}: its metadata describe no training; train the network anew with `bench train`")
    wrong = sorted({str(array.dtype) for array in arrays.values()} - {"float16", "float32"})
    if wrong:
        raise UserError(f"{path}: weights are {', '.join(wrong)}, expected float16 or float32")
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise UserError(f"{path}: tensor {name} has non-finite numbers; train the network anew")
    return Network(path, arrays, meta, digest)


def _are_metadata(meta: dict[str, Any]) -> bool:
    """Return whether the required metadata have their types."""
    others = meta.get("others", [])
    if not isinstance(others, list) or not all(isinstance(other, dict) for other in others):
        return False
    limits = meta.get("keypoints", [1, 1])
    if not (isinstance(limits, list) and len(limits) == 2 and all(type(limit) is int for limit in limits)):
        return False
    targets = [meta, *others]
    plugins = (meta["extractor"], *(target.get("defense") for target in targets))
    if not all(isinstance(plugin, dict) and isinstance(plugin.get("name"), str) for plugin in plugins):
        return False
    supported = [target.get("serves") for target in targets]
    if not all(isinstance(settings, dict) and all(map(_is_setting, settings.values())) for settings in supported):
        return False
    drafts = meta.get("drafts") or {}
    if not (isinstance(drafts, dict) and all(isinstance(digest, str) for digest in drafts.values())):
        return False
    if meta.get("model") not in list(MODELS):
        return False
    return isinstance(meta["shape"], dict) and type(meta["slots"]) is int and meta["encoding"] in get_args(Encoding)


def _is_setting(text: Any) -> bool:
    """Return whether `_decode_setting` reads a value."""
    if not isinstance(text, dict):
        return False
    limits, values = text.get("between"), text.get("one_of")
    if isinstance(limits, list):
        return len(limits) == 2 and all(isinstance(limit, int | float) for limit in limits)
    return isinstance(values, list) and all(isinstance(value, str | int | float | None) for value in values)


def initialise_from(fresh: AnyNetwork, trained: AnyNetwork, candidates: int) -> None:
    """Initialise a network from a network for the same kind of release, or for raw descriptors.

    From a network for raw descriptors, the first layer treats the first `candidates` slots as descriptors. These are the words of
    a set, or the point of a subspace nearest to zero. Weights are divided by √candidates, which preserves the size of a sum of
    independent slots. The other slots and the settings get weight zero. All other layers are copied. If the raw descriptors have
    another length, they are other features: the first layer remains as it is.

    If the levels are narrower, they take the first channels of each level of `trained`. A network that reads lines takes its
    inversion network from one that reads points. A network that samples photographs takes from an inversion network all but
    the head.

    Raises
    ------
    UserError
        if a level is wider, or `trained` reads neither such releases nor raw descriptors.
    """
    import torch

    from bench.inversion.flow import FlowNetwork
    from bench.inversion.line_network import LineInverter

    if isinstance(trained, FlowNetwork) and not isinstance(fresh, FlowNetwork):
        raise UserError("--initial-checkpoint: that network samples photographs; pass one that reconstructs them")
    with torch.no_grad():
        if isinstance(trained, LineInverter):
            if not isinstance(fresh, LineInverter):
                raise UserError("--initial-checkpoint: that network reads lines; pass a network for points")
            _copy_weights(fresh.inverter, trained.inverter, candidates)
            parts = trained.state_dict().items()
            fresh.load_state_dict({k: v for k, v in parts if not k.startswith("inverter.")}, strict=False)
        elif isinstance(fresh, LineInverter):
            _copy_weights(fresh.inverter, trained, candidates)
        else:
            _copy_weights(fresh, trained, candidates)


def _copy_weights(fresh: GridNetwork, trained: GridNetwork, candidates: int) -> None:
    first = "embed.0.weight"
    old, new = trained.state_dict(), fresh.state_dict()
    if trained.shape.posteriors and not fresh.shape.posteriors:
        raise UserError("--initial-checkpoint: that network reads posteriors; pass one for raw descriptors")
    if type(fresh) is not type(trained):  # they share all but the head
        old, new = ({name: state[name] for name in state if name in old and name in new} for state in (old, new))
    if len(fresh.shape.widths) == len(trained.shape.widths):
        old = {name: value[tuple(map(slice, new[name].shape))] if name != first else value for name, value in old.items()}
    if any(old[name].shape != value.shape for name, value in new.items() if name != first):
        raise UserError("--initial-checkpoint: that network has other sizes; pass equal or narrower --widths")
    for name in new.keys() - {first}:
        new[name].copy_(old[name])
    length = old[first].shape[1] - 2  # columns of the descriptor; the last two are the position within the cell
    if trained.shape.length == length != fresh.shape.length and not trained.shape.candidates:
        return
    if new[first].shape == old[first].shape:
        new[first].copy_(old[first])
        return
    slots = (new[first].shape[1] - 2) // max(1, length)
    if trained.shape.candidates or not length or slots < candidates:
        raise UserError(
            "--initial-checkpoint: that network is for other releases; pass a network for these releases or for raw descriptors"
        )
    new[first].zero_()
    new[first][:, : candidates * length] = (old[first][:, :length] / candidates**0.5).repeat(1, candidates)
    new[first][:, slots * length : slots * length + 2] = old[first][:, length:]


def list_training_stages(meta: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the training stages of a network from its metadata, the first stage first."""
    return [*meta.get("earlier", []), {key: meta.get(key) for key in STAGE_METADATA}]


def describe(
    targets: Sequence[Target], extractor: Extractor, public: Public, keypoints: tuple[int, int] | None = None
) -> dict[str, Any]:
    """Return the metadata that describe the releases of a training. Those of the first target are not nested.

    `keypoints` are the limits of a random `max_keypoints`.
    """
    first, *others = (_describe_target(target, public) for target in targets)
    nested = {"others": others} if others else {}
    limits = {} if keypoints is None else {"keypoints": list(keypoints)}
    return {**first, **nested, **limits, "extractor": spec.to_json_with_digests(extractor, public)}


def _describe_target(target: Target, public: Public) -> dict[str, Any]:
    configuration, supported = _configure(target.defense, public), target.supported_settings
    return {
        "defense": {field: value for field, value in configuration.items() if field not in supported},
        "serves": {field: _encode_setting(setting) for field, setting in supported.items()},
    }


def _configure(defense: Defense, public: Public) -> dict[str, Any]:
    """Return name and fields of a defense; of a composed one, its name and the fields of both parts."""
    parts = [spec.to_json_with_digests(part, public) for part in list_parts(defense)]
    return {field: value for part in parts for field, value in part.items()} | {"name": defense.name()}


def _list_targets(meta: dict[str, Any]) -> list[dict[str, Any]]:
    return [{"defense": meta["defense"], "serves": meta["serves"]}, *meta.get("others", [])]


def list_defenses(meta: dict[str, Any]) -> list[str]:
    """Return the names of the defenses that a network was trained for, sorted."""
    return sorted({target["defense"]["name"] for target in _list_targets(meta)})


def explain_incompatible(meta: dict[str, Any], defense: Defense, extractor: Extractor, public: Public) -> str | None:
    """Return the reason why a network does not suit the releases of `defense`; None if it was trained for them."""
    names = list_defenses(meta)
    if defense.name() not in names:
        return f"trained for {', '.join(names)}"
    if meta["extractor"]["name"] != extractor.name():  # a dictionary of other features follows from it
        return explain_other_features(meta, extractor, public)
    targets = [target for target in _list_targets(meta) if target["defense"]["name"] == defense.name()]
    alike = [target for target in targets if _explain_other_fields(target, defense, public) is None]
    reasons = [_explain_other_releases(target, defense, public) for target in alike or targets]
    if None not in reasons:
        return " or ".join(dict.fromkeys(reason for reason in reasons if reason))
    return explain_other_features(meta, extractor, public)


def find_network(
    asset: str,
    shipped: Mapping[str, str],
    defense: Defense,
    extractor: Extractor,
    public: Public,
    model: str | None = None,
) -> tuple[Path | None, str]:
    """Return the path of a network for these releases, or the reasons in brackets why none of the networks suits.

    `asset` is a file, or a name of shipped networks: `shipped` has the pattern of their files for each name. `model` is a key of
    `MODELS`.
    """
    candidates = sorted(ASSETS.glob(shipped[asset])) if asset in shipped else [Path(asset)]
    reasons = []
    for path in candidates:
        meta = load(path).meta
        if meta.get("model") != model:
            reasons.append(f"{path.name} is a network that {MODELS[meta.get('model')]}")
            continue
        reason = explain_incompatible(meta, defense, extractor, public)
        if reason is None:
            return path, ""
        if asset not in shipped or defense.name() in list_defenses(meta):
            reasons.append(f"{path.name} was {reason}")
    return None, f" ({'; '.join(reasons)})" if reasons else ""


@dataclass(frozen=True)
class AdaptedNetworks:
    """The networks that an attack can load. It uses the one that was trained for the releases."""

    attack: str
    asset: str  # its field `weights`
    shipped: Mapping[str, str]
    model: str | None = None  # a key of `MODELS`

    def explain_missing(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        """Return the reason why there is no network for these releases, and the next step; None if there is one."""
        path, details = find_network(self.asset, self.shipped, defense, extractor, public, self.model)
        if path is not None:
            return None
        features = spec.to_text(extractor)
        options = [
            *([] if self.model is None else ["--model", self.model]),
            *("--defense", spec.to_text(defense)),
            *([] if features == DEFAULT_EXTRACTOR else ["--extractor", features]),
        ]
        command = shlex.join(["bench", "train", *options])
        return f"no adapted attacker{details}; train one with `{command}` and pass {self.attack}:weights=FILE"

    def load(self, defense: Defense, extractor: Extractor, public: Public) -> Network:
        """Load the network for these releases.

        Raises
        ------
        UserError
            if there is none.
        """
        path, _ = find_network(self.asset, self.shipped, defense, extractor, public, self.model)
        if path is None:
            raise UserError(f"{self.attack}: {self.explain_missing(defense, extractor, public)}")
        return load(path)


def _explain_other_releases(target: dict[str, Any], defense: Defense, public: Public) -> str | None:
    """Return the reason why the releases of one target are not those of `defense`."""
    if (reason := _explain_other_fields(target, defense, public)) is not None:
        return reason
    for field, setting in _decode_settings(target).items():
        if getattr(defense, field) not in setting:
            return f"trained for {field} {setting}, not {getattr(defense, field)}"
    return None


def _explain_other_fields(target: dict[str, Any], defense: Defense, public: Public) -> str | None:
    """Return the reason why `defense` is none of one target, whatever its supported settings."""
    trained_for, supported = target["defense"], _decode_settings(target)
    if trained_for["name"] != defense.name():
        return f"trained for {trained_for['name']}"
    configuration = _configure(defense, public)
    defaults = {name: value for part in list_parts(defense) for name, value in fields.list_defaults(type(part)).items()}
    trained = defaults | trained_for  # a field added after the training counts as its default
    for field in sorted((configuration.keys() | trained_for.keys()) - supported.keys()):
        if configuration.get(field) != trained.get(field):
            return f"trained for {field} {trained.get(field)}, not {configuration.get(field)}"
    return None


def explain_other_features(meta: dict[str, Any], extractor: Extractor, public: Public) -> str | None:
    """Return the reason why a network does not suit the features of `extractor`; None if it was trained for them."""
    if meta["extractor"]["name"] != extractor.name():  # their fields have little in common
        return f"trained for features of {meta['extractor']['name']}, not {extractor.name()}"
    features = spec.to_json_with_digests(extractor, public)
    limits = meta.get("keypoints")
    for field in sorted(meta["extractor"].keys() | features.keys()):
        if field == LIMIT and limits is not None:
            if not limits[0] <= features[field] <= limits[1]:
                return f"trained for features with {field} from {limits[0]} to {limits[1]}, not {features[field]}"
        elif meta["extractor"].get(field) != features.get(field):
            expected, actual = meta["extractor"].get(field), features.get(field)
            return f"trained for features with {field} {expected}, not {actual}"
    return None


def _encode_setting(setting: Between | OneOf) -> dict[str, list[Any]]:
    return {"between": [setting.low, setting.high]} if isinstance(setting, Between) else {"one_of": list(setting.values)}


def _decode_settings(target: dict[str, Any]) -> dict[str, Between | OneOf]:
    return {field: _decode_setting(text) for field, text in target["serves"].items()}


def _decode_setting(text: dict[str, list[Any]]) -> Between | OneOf:
    return Between(*text["between"]) if "between" in text else OneOf(tuple(text["one_of"]))
