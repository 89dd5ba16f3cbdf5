"""The device and the number format of heavy arithmetic."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch


def pick_device() -> torch.device:
    """Return CUDA if available, else Apple's MPS, else the CPU."""
    import torch

    if torch.cuda.is_available():
        return torch.device("cuda")
    if torch.backends.mps.is_available():
        return torch.device("mps")
    return torch.device("cpu")


def pick_double_device() -> torch.device:
    """Return the device for float64: MPS does not support it."""
    import torch

    device = pick_device()
    return torch.device("cpu") if device.type == "mps" else device


def pick_dtype(device: torch.device) -> torch.dtype:
    """Return bf16 if the hardware multiplies it faster than float32, else float32."""
    import torch

    if device.type == "cuda":
        return torch.bfloat16 if torch.cuda.is_bf16_supported() else torch.float32
    return torch.bfloat16 if device.type == "cpu" and _has_bf16_products() else torch.float32


def has_byte_products() -> bool:
    """Return whether the processor multiplies 8-bit integers faster than float32: VNNI of AVX-512."""
    return _has_instructions(("avx512_vnni",), ("_is_vnni_supported", "_is_avx512_vnni_supported"))


def _has_bf16_products() -> bool:
    """Whether the processor has instructions for products in bf16: AMX or AVX-512."""
    return _has_instructions(("amx_bf16", "avx512_bf16"), ("_is_amx_tile_supported", "_is_avx512_bf16_supported"))


def _has_instructions(names: Sequence[str], functions: Sequence[str]) -> bool:
    """Whether the processor has one of these sets. The functions answer before torch 2.13; torch 2.4 lacks some of them."""
    import torch

    if hasattr(torch.cpu, "get_capabilities"):
        capabilities = torch.cpu.get_capabilities()
        return any(capabilities.get(name) for name in names)
    queries = (getattr(torch.cpu, name, None) for name in functions)
    return any(query() for query in queries if query is not None)
