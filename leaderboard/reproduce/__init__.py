"""The paper's tables and figures, beside the paper's own numbers: `bench reproduce`."""

from leaderboard.reproduce.command import Reproduction, list_materials, reproduce

__all__ = ["Reproduction", "list_materials", "reproduce"]
