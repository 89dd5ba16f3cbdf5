"""The images of torchvision's datasets, as they lie on disk: `torchvision:Places365,root=DIR,split=val`.

The fields are the arguments of the class in `torchvision.datasets`. Any class whose items begin with an image can be used.
Nothing is downloaded. If the images are files, their paths are listed, so that a photograph has the same pixels, by the rule
of `photographs`, and the same hash as in a folder. Images inside other files, as those of CIFAR-10, are read by their index.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from PIL import Image

from bench.core.errors import SampleError, UserError, unknown_name
from bench.registry import fields

PREFIX = "torchvision:"
KINDS = (bool, int, float, str)  # of arguments that can be given as text


class _OpenedError(BaseException):
    """A dataset has opened an image file. It is no `Exception`, which a dataset could catch."""

    def __init__(self, path: Path) -> None:
        self.path = path


def is_dataset(images: Path | str) -> bool:
    """Return whether the text names a dataset of torchvision, and no folder."""
    return str(images).startswith(PREFIX)


def format_name(text: str) -> str:
    """Return a short name of the dataset without its paths.

    >>> format_name("torchvision:Places365,root=/data/places,split=val")
    'Places365-val'
    """
    name, *given = text.removeprefix(PREFIX).split(",")
    values = (part.partition("=")[2] for part in given if part.partition("=")[0] != "root")
    return "-".join([name, *(value for value in values if "/" not in value and "\\" not in value)])


def list_images(text: str) -> list[tuple[str, Path | None]]:
    """Return the name and the file of each image of a dataset, in its order. The file is None for images in no file of their own.

    The name of a file is its path below `root`. That of another image is its index.

    Raises
    ------
    UserError
        if torchvision, the class, an argument or a file is missing, or the items are no images.
    """
    dataset, root = _open(text)
    count = _call(text, lambda: len(dataset))
    if not count:
        raise UserError(f"--images {text}: the dataset is empty")
    with _stop_at_files():
        first = _find_file(text, dataset, 0)
        if first is None:
            return [(f"{index:0{len(str(count - 1))}d}", None) for index in range(count)]
        files = [_find_file(text, dataset, index) for index in range(count)]
    return [(_name_file(path, root), path) for path in dict.fromkeys(files) if path is not None]


def read_image(text: str, index: int) -> Image.Image:
    """Return one image of a dataset.

    Raises
    ------
    SampleError
        if it cannot be read.
    """
    dataset, _ = _open(text)
    try:
        image = _select_image(dataset[index])
    except Exception as error:  # the classes raise errors of any kind for damaged files
        raise SampleError(f"image {index} of {text}: {error}") from error
    if image is None:
        raise SampleError(f"image {index} of {text}: not an image")
    return image


@functools.lru_cache(maxsize=2)
def _open(text: str) -> tuple[Any, Path | None]:
    """Return the dataset of a text, and its root."""
    plugin, given = _parse(text)
    root = Path(given["root"]).expanduser() if "root" in given else None
    if root is not None and not root.is_dir():
        raise UserError(f"--images {text}: {root}: no such folder")
    return _call(text, lambda: plugin(**given)), root


def _parse(text: str) -> tuple[type, dict[str, Any]]:
    """Return the class and its arguments."""
    try:
        from torchvision import datasets
    except ImportError:
        raise UserError(
            f"--images {text}: torchvision is not installed; pip install 'feature-privacy-bench[torchvision]'"
        ) from None
    classes = {name: getattr(datasets, name) for name in datasets.__all__ if _is_class(getattr(datasets, name))}
    name, *parts = text.removeprefix(PREFIX).split(",")
    if name not in classes:
        raise unknown_name("dataset of torchvision", name, classes)
    kinds = _list_arguments(classes[name])
    given: dict[str, Any] = {}
    for part in parts:
        field, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals:
            raise UserError(f"{text!r}: {part!r} is not field=value (write {PREFIX}NAME,field=value,field=value)")
        if field == "download":
            raise UserError(f"{PREFIX}{name}: download: nothing is downloaded here; remove it (bench dataset fetch downloads)")
        if field not in kinds:
            raise unknown_name(f"field of {PREFIX}{name}", field, kinds)
        if field in given:
            raise UserError(f"{text!r}: {field} is given twice")
        try:
            given[field] = fields.parse_value(kinds[field], value)
        except ValueError:
            raise UserError(f"{PREFIX}{name}: {field} must be {fields.describe_type(kinds[field])}, not {value!r}") from None
    required = (field for field, argument in _parameters(classes[name]).items() if argument.default is argument.empty)
    missing = [field for field in required if field not in given]
    if missing:
        raise UserError(f"{PREFIX}{name} needs {', '.join(missing)}: write {PREFIX}{name},{missing[0]}=...")
    return classes[name], given


def _is_class(value: Any) -> bool:
    from torchvision.datasets import VisionDataset

    return inspect.isclass(value) and issubclass(value, VisionDataset) and value is not VisionDataset


def _parameters(plugin: type) -> dict[str, inspect.Parameter]:
    parameters = inspect.signature(plugin).parameters.items()
    return {name: value for name, value in parameters if value.kind is not value.VAR_KEYWORD}


def _list_arguments(plugin: type) -> dict[str, Any]:
    """Return the arguments of a class that can be given as text, with their types. Transforms and loaders are functions."""
    hints = get_type_hints(plugin.__init__)  # type: ignore[misc]  # of a class, not of an instance
    accepted = {}
    for name in _parameters(plugin).keys() & hints.keys() - {"download"}:
        hint = hints[name]
        parts = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
        kind = next((kind for kind in KINDS if kind in parts), None)
        if kind is not None and not name.startswith("_"):
            accepted[name] = kind
    return accepted


def _find_file(text: str, dataset: Any, index: int) -> Path | None:
    """Return the file that a dataset opens for an item; None if it returns an image without one."""

    def load() -> Any:
        try:
            return dataset[index]
        except FileNotFoundError as error:  # some loaders open the file before Pillow
            raise _OpenedError(Path(error.filename)) from None

    try:
        item = _call(text, load)
    except _OpenedError as opened:
        return opened.path
    if _select_image(item) is None:
        first = item[0] if isinstance(item, tuple) and item else item
        raise UserError(f"--images {text}: its items begin with {type(first).__name__}, not with an image; use another dataset")
    return None


def _select_image(item: Any) -> Image.Image | None:
    """Return the image of an item, which is an image or a tuple that begins with one."""
    first = item[0] if isinstance(item, tuple) and item else item
    return first if isinstance(first, Image.Image) else None


def _name_file(path: Path, root: Path | None) -> str:
    return path.relative_to(root if root is not None and path.is_relative_to(root) else path.anchor).as_posix()


@contextmanager
def _stop_at_files() -> Iterator[None]:
    """Raise `_OpenedError` in place of opening an image file: torchvision has no other way to ask each class for its paths."""
    original = Image.open

    def stop(file: Any, *args: Any, **options: Any) -> Image.Image:
        name = getattr(file, "name", file)
        if isinstance(name, (str, Path)):
            raise _OpenedError(Path(name))
        return original(file, *args, **options)  # an image inside another file, such as a database

    Image.open = stop  # type: ignore[assignment]
    try:
        yield
    finally:
        Image.open = original


def _call(text: str, function: Any) -> Any:
    """Call torchvision, and raise UserError for its errors, which are of any class."""
    try:
        return function()
    except ImportError as error:
        raise UserError(f"--images {text}: {error}; install the package") from error
    except Exception as error:
        reason = str(error).partition(" You can")[0] or type(error).__name__  # the rest advises `download=True`
        raise UserError(
            f"--images {text}: {reason}; write the files as torchvision's documentation says, or see bench dataset fetch"
        ) from error
