"""The data of the paper that a reproduction lacks: the commands exist, and the options are those that the rows use."""

import dataclasses
import re
import shlex

import pytest

from bench import cli
from bench.cli import build_parser
from bench.formats.published import DATASETS
from bench.registry import discovery, fields, spec
from bench.settings import Asset
from leaderboard import reproduce
from leaderboard.reproduce import paper_data, tables
from leaderboard.reproduce.command import group_drawings
from leaderboard.reproduce.profiles import CPU, Materials, Setting

NAMES = sorted({**tables.load_tables(), **group_drawings()})
ALL = {"images", "dataset", *reproduce.list_materials()}


@pytest.mark.parametrize("name", NAMES)
def test_commands_of_the_lines_are_valid(name: str) -> None:
    lines = reproduce.list_missing(name, ())
    assert lines
    assert reproduce.list_missing(name, ALL) == ()
    for line in lines:
        for fetch in re.findall(r"bench (dataset fetch \S+ --to DIR)", line):
            args = build_parser().parse_args(shlex.split(fetch))
            assert args.name in DATASETS
        for dataset in re.findall(r"--dataset (\S+)", line):
            spec.parse(dataset, discovery.DATASET)
        for option in re.findall(r"(--[a-z-]+-(?:database|network)|--d[a-z]+y|--database)", line):
            assert option.removeprefix("--").replace("-", "_") in ALL


def test_scenes_are_those_of_the_paper() -> None:
    assert "Aachen Day-Night v1.1" in reproduce.list_missing("table2", ())[0]
    assert [line.partition(" (")[0] for line in reproduce.list_missing("tableS2", ())] == ["South Building", "Fountain-P11"]
    assert reproduce.list_missing("table2", {"dataset"}) == ()


@pytest.mark.parametrize("name", [name for name, table in tables.load_tables().items() if table.dataset is None])
def test_dictionaries_are_those_of_the_rows(name: str) -> None:
    """Each field of `Materials` gets a name of its own; table 4 checks the size of its dictionary, which is the shipped one."""
    table = tables.load_tables()[name]
    options = ("dictionary", "database", "public_database")
    materials = Materials(**{option: Asset(f"/{option}") for option in options if (name, option) != ("table4", "dictionary")})
    setting = Setting(profile=CPU, materials=materials, extractor=table.extractor(CPU), photographs=7)
    plugins = [plugin for row in table.build_rows(setting) for plugin in (row.defense, row.attack) if plugin is not None]
    used = {str(value).removeprefix("/") for plugin in plugins for value in fields.list_assets(plugin).values()}
    ldp = {str(getattr(plugin, "dictionary", "")) for plugin in plugins}
    found = (used & set(options)) | ({"dictionary"} if "shipped" in ldp else set())
    compared = {"database", "public_database"} if name == "table4" else set()  # of the rows of Table 1 beside it
    assert set(paper_data.DICTIONARIES.get(name, ())) == found | compared


def test_profile_paper_names_what_it_lacks_before_it_runs(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["reproduce", "table4", "--profile", "paper"]) == 2  # the shipped dictionary is too small
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition(":")[0] for line in lines] == ["bench"] * 4
    assert "bench dataset fetch places365-train-256 --to DIR" in lines[1]
    assert "--dictionary, --database, --public-database" in lines[1]
    assert "bench dataset fetch megadepth --to DIR" in lines[2]
    assert "profile paper needs 512,000" in lines[3]
    assert cli.main(["reproduce", "table4", "--profile", "papers"]) == 2
    assert "not the paper's" not in capsys.readouterr().err


def test_materials_have_these_fields() -> None:
    names = {field.name for field in dataclasses.fields(Materials)}
    for options in (*paper_data.DICTIONARIES.values(), *paper_data.NETWORKS.values()):
        assert set(options) <= names
