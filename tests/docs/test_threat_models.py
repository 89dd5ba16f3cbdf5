"""docs/threat-models.md has the release types and the knowledge that each attack declares; docs/attacks.md lists the plugins."""

import re
from pathlib import Path

import pytest

from bench import threat_model
from bench.api import Attack, ImageAttack, PositionAttack
from bench.registry import discovery
from bench.threat_model import Knowledge
from bench.types import Descriptors, Lines, Points, Positions, Release, Subspaces, WordSets

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE = (DOCS / "threat-models.md").read_text(encoding="utf-8")
LIST = (DOCS / "attacks.md").read_text(encoding="utf-8")
RELEASES: dict[str, type[Release]] = {"descriptors": Descriptors, "subspaces": Subspaces, "word sets": WordSets}
ANY: dict[str, type[Positions]] = {"any": Positions, "any with positions": Points, "any with lines": Lines}
ATTACKS = {
    attack.name(): attack for attack in discovery.load_plugins(discovery.ATTACK) if attack.__module__.startswith("attacks.")
}


def read_rows(page: str) -> dict[str, list[str]]:
    """Return the columns release, knowledge and recovers of each attack's row."""
    rows = re.findall(r"^\| \[`([a-z-]+)`\]\(#\1\) \| (.+?) \| (.+?) \| (.+?) \|", page, re.MULTILINE)
    return {name: columns for name, *columns in rows}


def test_every_attack_has_a_row_and_a_section() -> None:
    assert read_rows(PAGE).keys() == ATTACKS.keys() == set(re.findall(r"^### `(.+)`$", PAGE, re.MULTILINE))


def list_wrong_rows(page: str) -> list[str]:
    """Return the attacks whose row differs from the declarations."""
    return [name for name, columns in read_rows(page).items() if not _agrees(ATTACKS[name], *columns)]


def _agrees(attack: type[Attack], releases: str, knowledge: str, recovers: str) -> bool:
    accepted = RELEASES.values() if releases in ANY else [RELEASES[kind] for kind in releases.split(", ")]
    return (
        set(accepted) == set(attack.accepts)
        and (releases not in ANY or attack.accepts_positions == (ANY[releases],))
        and set(re.findall(r"`(\w+)`", knowledge)) == {kind.__name__ for kind in attack.needs}
        and ("image" in recovers.split(", ")) == issubclass(attack, ImageAttack)
        and ("positions" in recovers.split(", ")) == issubclass(attack, PositionAttack)
    )


def test_rows_have_the_declarations() -> None:
    assert not list_wrong_rows(PAGE)


@pytest.mark.parametrize(
    ("old", "new"), [("`DefenseDatabase`", "none"), ("subspaces", "word sets"), ("descriptors | database attack", "image | x")]
)
def test_a_wrong_row_is_noticed(old: str, new: str) -> None:
    row = next(line for line in PAGE.splitlines() if line.startswith("| [`database`]"))
    assert list_wrong_rows(PAGE.replace(row, row.replace(old, new))) == ["database"]


@pytest.mark.parametrize(
    ("name", "old", "new"), [("generative", "any with positions", "any"), ("blank", "any", "any with lines")]
)
def test_wrong_positions_are_noticed(name: str, old: str, new: str) -> None:
    assert list_wrong_rows(PAGE.replace(f"(#{name}) | {old} |", f"(#{name}) | {new} |")) == [name]


def test_every_kind_of_knowledge_is_explained() -> None:
    kinds = {name for name, kind in vars(threat_model).items() if isinstance(kind, type) and issubclass(kind, Knowledge)}
    assert set(re.findall(r"^\| `(\w+)` \|", PAGE, re.MULTILINE)) == kinds - {"Knowledge"}


def list_missing(page: str) -> set[str]:
    """Return the names of the built-in attacks and defenses that have no row in their tables, or have a row and do not exist."""
    defenses = {one.name() for one in discovery.load_plugins(discovery.DEFENSE) if one.__module__.startswith("defenses.")}
    return (ATTACKS.keys() ^ list_rows(page, "Attacks")) | (defenses ^ list_rows(page, "Defenses"))


def list_rows(page: str, title: str) -> set[str]:
    """Return the names in the first column of a section's table."""
    section = page.partition(f"\n## {title}\n")[2].partition("\n## ")[0]
    return set(re.findall(r"^\| `([a-z-]+)` \|", section, re.MULTILINE))


def test_every_plugin_is_listed() -> None:
    assert list_missing(LIST) == set()


@pytest.mark.parametrize("name", ["snap", "permutation"])
def test_a_missing_plugin_is_noticed(name: str) -> None:
    assert list_missing(LIST.replace(f"| `{name}` |", "| `other` |")) == {name, "other"}
