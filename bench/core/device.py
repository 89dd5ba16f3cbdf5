"""Which device and which number format heavy arithmetic runs in."""

from __future__ import annotations

import torch


def pick_device() -> torch.device:
    """CUDA where there is one, else Apple's MPS, else the CPU."""
    if torch.cuda.is_available():
        return torch.device("cuda")
    if torch.backends.mps.is_available():
        return torch.device("mps")
    return torch.device("cpu")


def pick_double_device() -> torch.device:
    """The device for float64, which MPS does not have."""
    device = pick_device()
    return torch.device("cpu") if device.type == "mps" else device


def pick_dtype(device: torch.device) -> torch.dtype:
    """bf16 where the hardware multiplies it faster than float32, else float32."""
    if device.type == "cuda":
        return torch.bfloat16 if torch.cuda.is_bf16_supported() else torch.float32
    if device.type == "cpu":
        has = torch.cpu.get_capabilities()
        return torch.bfloat16 if has.get("amx_bf16") or has.get("avx512_bf16") else torch.float32
    return torch.float32
