"""Reproduces the paper's tables and figures, next to the paper's own numbers: `bench reproduce`."""

from leaderboard.reproduce.command import Reproduction, list_materials, reproduce

__all__ = ["Reproduction", "list_materials", "reproduce"]
