"""An optional TensorBoard log of a training."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from bench.core.errors import UserError

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter


class Log:
    """Writes numbers by name and step for TensorBoard; writes nothing if the folder is None."""

    def __init__(self, folder: Path | None) -> None:
        """Open the log, or continue an existing one.

        Raises
        ------
        UserError
            if tensorboard is not installed.
        """
        self._writer: SummaryWriter | None = None
        if folder is None:
            return
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            raise UserError("--log needs tensorboard: pip install 'feature-privacy-bench[logs]'") from None
        self._writer = SummaryWriter(str(folder))

    def add_scalars(self, values: Mapping[str, float], step: int) -> None:
        if self._writer is not None:
            for name, value in values.items():
                self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
