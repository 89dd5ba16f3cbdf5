"""The processes that train one network, each on a device of its own and on its part of every batch.

Lightning Fabric starts them; PyTorch's `DistributedDataParallel` averages their gradients. What they compute is what one process
computes of the whole batch, up to rounding: parts are equal, and batch norm is over all of them.
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

from bench.core.device import pick_device
from bench.core.errors import UserError
from bench.inversion import norm

if TYPE_CHECKING:
    from lightning_fabric import Fabric

# That processes start is no news; each of them imports this module before Fabric says so.
for talkative in ("distributed", "rank_zero"):
    logging.getLogger(f"lightning_fabric.utilities.{talkative}").setLevel(logging.WARNING)


@dataclass(frozen=True, eq=False)
class Team:
    """One process's place among them all; alone by default."""

    rank: int = 0
    size: int = 1
    fabric: Fabric | None = None

    @property
    def leads(self) -> bool:
        """Whether this is the one that writes files and reports."""
        return self.rank == 0

    def part(self, batch: int) -> range:
        """The places of a batch that this process computes."""
        each = batch // self.size
        return range(self.rank * each, (self.rank + 1) * each)

    def share(self, module: nn.Module) -> nn.Module:
        """What to call in training instead of the module, so that its gradients are those of the whole batch."""
        if self.fabric is None:
            return module
        if pick_device().type == "cuda":
            module = nn.SyncBatchNorm.convert_sync_batchnorm(module)
        else:
            norm.joint(module)
        return self.fabric.strategy.setup_module(module)

    def mean(self, value: torch.Tensor) -> float:
        """The mean over all processes."""
        if self.fabric is not None:
            reduced = self.fabric.all_reduce(value, reduce_op="mean")
            assert isinstance(reduced, torch.Tensor)
            value = reduced
        return float(value)


def launch(devices: int, batch: int, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Run function(team, *args, **kwargs) in as many processes, and return what it returns in the first. All must be picklable.

    Raises
    ------
    UserError
        if there are fewer devices, they cannot share the batch equally, or Lightning Fabric is not installed.
    Exception
        a `UserError` or `OSError` of the function.
    """
    if devices == 1:
        return function(Team(), *args, **kwargs)
    device = pick_device().type
    there = {"cuda": torch.cuda.device_count(), "cpu": os.cpu_count() or 1}.get(device, 1)
    if not 1 < devices <= there:
        raise UserError(f"--devices {devices}: from 1 to {there} can be used here ({device})")
    if batch % devices:
        raise UserError(f"--batch {batch}: {devices} devices cannot share that equally; take a multiple of {devices}")
    try:
        from lightning_fabric import Fabric
    except ImportError:
        raise UserError("--devices needs Lightning Fabric: pip install 'feature-privacy-bench[devices]'") from None
    fabric = Fabric(accelerator=device, devices=devices, strategy="ddp_spawn")
    with tempfile.TemporaryDirectory() as folder:
        failure = Path(folder) / "failure"
        try:
            return fabric.launch(partial(_work, failure=failure, function=function, args=args, kwargs=kwargs))
        except torch.multiprocessing.ProcessRaisedException:
            if failure.is_file():
                raise pickle.loads(failure.read_bytes()) from None
            raise


def _work(fabric: Fabric, failure: Path, function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """What each process does. An error that is meant for the user is left in a file, for exceptions reach the parent as text."""
    team = Team(fabric.global_rank, fabric.world_size, fabric)
    if not team.leads:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  # one report is enough; open while the process lives
    try:
        return function(team, *args, **kwargs)
    except (UserError, OSError) as error:
        failure.with_name(f"{team.rank}").write_bytes(pickle.dumps(error))
        failure.with_name(f"{team.rank}").replace(failure)
        raise
