"""The leaderboard as a folder, from records alone: tables, plots, and a page that needs no network."""

from leaderboard.site.write import WrittenSite, write

__all__ = ["WrittenSite", "write"]
