"""Reproduces the paper's tables and figures, next to the paper's own numbers: `bench reproduce`."""

from leaderboard.reproduce.command import Reproduction, list_materials, list_missing, reproduce

__all__ = ["Reproduction", "list_materials", "list_missing", "reproduce"]
