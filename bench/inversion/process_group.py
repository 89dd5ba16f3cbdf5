"""A group of processes that train one network: each on its own device, with its part of every batch.

Lightning Fabric starts them, and PyTorch's `DistributedDataParallel` averages their gradients. All parts have equal size, and
batch norm uses the whole batch. So the result equals that of one process with the whole batch, up to rounding.
"""

from __future__ import annotations

import logging
import os
import pickle
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from bench.core.child_process import end_with_parent
from bench.core.device import pick_device
from bench.core.errors import UserError
from bench.inversion import norm

if TYPE_CHECKING:
    from lightning_fabric import Fabric

# Silence messages about process starts; each process imports this module before Fabric logs them.
for module_name in ("distributed", "rank_zero"):
    logging.getLogger(f"lightning_fabric.utilities.{module_name}").setLevel(logging.WARNING)


@dataclass(frozen=True, eq=False)
class ProcessGroup:
    """The group of processes as seen by one of them; a single process by default."""

    rank: int = 0
    size: int = 1
    fabric: Fabric | None = None

    @property
    def is_main(self) -> bool:
        """Whether this process writes files and shows progress."""
        return self.rank == 0

    def assign_indices(self, batch: int) -> range:
        """Return the indices of the batch that this process computes."""
        count = batch // self.size
        return range(self.rank * count, (self.rank + 1) * count)

    def wrap(self, module: nn.Module) -> nn.Module:
        """Wrap a module for training, so that its gradients are those of the whole batch."""
        if self.fabric is None:
            return module
        if pick_device().type == "cuda":
            module = nn.SyncBatchNorm.convert_sync_batchnorm(module)
        else:
            norm.convert_batch_norms(module)
        return self.fabric.strategy.setup_module(module)

    def average(self, value: torch.Tensor) -> float:
        """Return the mean over all processes."""
        if self.fabric is not None:
            reduced = self.fabric.all_reduce(value, reduce_op="mean")
            assert isinstance(reduced, torch.Tensor)
            value = reduced
        return float(value)


def launch(devices: int, batch: int, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Run function(group, *args, **kwargs) in one process per device, and return the main process's result. All are pickled.

    Raises
    ------
    UserError
        if there are too few devices, the batch is no multiple of their number, or Lightning Fabric is not installed.
    Exception
        any `UserError` or `OSError` of the function.
    """
    if devices == 1:
        return function(ProcessGroup(), *args, **kwargs)
    device = pick_device().type
    available = {"cuda": torch.cuda.device_count(), "cpu": os.cpu_count() or 1}.get(device, 1)
    if not 1 < devices <= available:
        raise UserError(f"--devices {devices}: must be from 1 to {available} on this machine ({device})")
    if batch % devices:
        raise UserError(f"--batch {batch}: must be a multiple of {devices}, the number of devices")
    try:
        from lightning_fabric import Fabric
    except ImportError:
        raise UserError("--devices needs Lightning Fabric: pip install 'feature-privacy-bench[devices]'") from None
    fabric = Fabric(accelerator=device, devices=devices, strategy="ddp_spawn")
    with tempfile.TemporaryDirectory() as folder:
        failure = Path(folder) / "failure"
        try:
            return fabric.launch(partial(_run_worker, failure=failure, function=function, args=args, kwargs=kwargs))
        except torch.multiprocessing.ProcessRaisedException:
            if failure.is_file():
                raise pickle.loads(failure.read_bytes()) from None
            raise


def _run_worker(
    fabric: Fabric, failure: Path, function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]
) -> Any:
    """Run the function in one process. Errors for the user are pickled to a file, since exceptions reach the parent as text."""
    end_with_parent()
    group = ProcessGroup(fabric.global_rank, fabric.world_size, fabric)
    if not group.is_main:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  # only the main process reports; open until the process ends
    try:
        return function(group, *args, **kwargs)
    except (UserError, OSError) as error:
        failure.with_name(f"{group.rank}").write_bytes(pickle.dumps(error))
        failure.with_name(f"{group.rank}").replace(failure)
        raise
