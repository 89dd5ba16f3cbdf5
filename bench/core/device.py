"""The device and the number format of heavy arithmetic."""

from __future__ import annotations

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


def _has_bf16_products() -> bool:
    """Whether the processor has instructions for products in bf16: AMX or AVX-512."""
    import torch

    if hasattr(torch.cpu, "get_capabilities"):  # since torch 2.13
        capabilities = torch.cpu.get_capabilities()
        return bool(capabilities.get("amx_bf16") or capabilities.get("avx512_bf16"))
    # Torch 2.4 has neither function: float32.
    queries = (getattr(torch.cpu, name, None) for name in ("_is_amx_tile_supported", "_is_avx512_bf16_supported"))
    return any(query() for query in queries if query is not None)
