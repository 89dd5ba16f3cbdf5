"""A network that was read from a file: its tensors and metadata, and the module, which is built at first use."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from bench.core.errors import UserError
from bench.formats.tensor_file import Arrays

if TYPE_CHECKING:
    from torch import nn

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class NetworkFile(ABC):
    """Base class of the kinds of networks that are read from files."""

    path: Path
    arrays: Arrays
    meta: dict[str, Any]
    digest: str

    @property
    @abstractmethod
    def module(self) -> nn.Module:
        """The module. Raises UserError if its tensors do not match its metadata."""

    def verify(self) -> str:
        """Compare the tensors with the metadata, and return the digest.

        Raises
        ------
        UserError
            if they do not match.
        """
        _ = self.module
        return self.digest


def build_module(path: Path, build: Callable[[], T]) -> T:
    """Return the module that `build` constructs from the metadata of the file.

    Raises
    ------
    UserError
        if the metadata describe no module.
    """
    try:
        return build()
    except (ArithmeticError, AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        raise UserError(f"{path}: its metadata describe no network: {type(error).__name__}: {error}") from error
