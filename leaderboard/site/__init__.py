"""The leaderboard as a folder: tables, plots, and a page that needs no network. All of it is made from records alone."""

from leaderboard.site.write import Done, write

__all__ = ["Done", "write"]
