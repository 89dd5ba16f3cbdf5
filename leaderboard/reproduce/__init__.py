"""The paper's tables and figures, rebuilt beside the paper's own numbers: `bench reproduce`."""

from leaderboard.reproduce.command import Done, materials, reproduce

__all__ = ["Done", "materials", "reproduce"]
