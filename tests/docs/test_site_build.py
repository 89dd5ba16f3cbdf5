"""The site of the documents builds without a warning, and opens from the disk in a real browser, wide and narrow."""

import dataclasses
import html
import importlib
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser import open_browser

import bench
from bench.registry import discovery
from defenses.ldp import LDP
from metrics.psnr import PSNR

pytest.importorskip("material", reason="the extra `docs` is not installed")
from mkdocs.commands.build import build
from mkdocs.config import load_config
from mkdocs.exceptions import Abort

ROOT = Path(__file__).resolve().parents[2]
MODULES = ("api", "task_api", "types", "settings", "threat_model", "testing")
KINDS = (discovery.ATTACK, discovery.DEFENSE, discovery.METRIC, discovery.TASK, discovery.DATASET, discovery.EXTRACTOR)


def build_site(folder: Path, **changes: Any) -> Path:
    """Build the site as `make docs` does, into another folder.

    Raises
    ------
    Abort
        if there is a warning.
    """
    build(load_config(str(ROOT / "mkdocs.yml"), strict=True, site_dir=str(folder), **changes))
    return folder


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_site(tmp_path_factory.mktemp("site"))


def list_ids(page: Path) -> set[str]:
    return set(re.findall(r'\bid="([^"]+)"', page.read_text(encoding="utf-8")))


def read_fields(page: Path, plugin: type) -> dict[str, str]:
    """Return name -> text of the fields and class variables that the page of the reference lists for a plugin."""
    identifier = f'id="{plugin.__module__}.{plugin.__name__}"'
    section = page.read_text(encoding="utf-8").partition(identifier)[2].partition("<h2")[0]
    rows = re.findall(r'<tr class="doc-section-item">(.*?)</tr>', section, re.DOTALL)
    texts = [html.unescape(re.sub(r"<[^>]+>", "", row)).split(maxsplit=1) for row in rows]
    return {name: " ".join(text.split()) for name, text in texts}


@pytest.mark.slow
def test_all_public_names_are_documented(built: Path) -> None:
    names = {f"bench.{name}" for name in bench.__all__ if name != "__version__"}
    assert names <= list_ids(built / "reference" / "index.html")
    for name in MODULES:
        module = importlib.import_module(f"bench.{name}")
        members = inspect.getmembers(module, lambda member: inspect.isclass(member) or inspect.isfunction(member))
        defined = [title for title, member in members if member.__module__ == module.__name__ and member.__doc__]
        public = {f"bench.{name}.{title}" for title in defined if not title.startswith("_")}
        assert public
        assert public <= list_ids(built / "reference" / f"{name}.html")


@pytest.mark.slow
def test_all_plugins_are_documented_with_their_fields_and_without_helpers(built: Path) -> None:
    for kind in KINDS:
        page = built / "reference" / f"{kind.package.removeprefix('bench.')}.html"
        plugins = discovery.load_plugins(kind)
        for plugin in plugins:
            fields = {field.name for field in dataclasses.fields(plugin)}  # type: ignore[arg-type]
            assert fields <= read_fields(page, plugin).keys(), plugin
        classes = {f"{plugin.__module__}.{plugin.__name__}" for plugin in plugins}
        modules = {plugin.__module__ for plugin in plugins}
        shown = {name for name in list_ids(page) if name.startswith(f"{kind.package}.")}
        assert shown >= classes | modules
        assert {name.rpartition(".")[0] for name in shown - classes - modules} <= classes  # methods alone


@pytest.mark.slow
def test_comments_of_fields_are_shown(built: Path) -> None:
    """A field is shown with its comment, type and default, and a class variable with its value."""
    (comment,) = re.findall(r"^    epsilon: float = 10.0  # (.+)$", (ROOT / "defenses/ldp.py").read_text("utf-8"), re.MULTILINE)
    assert read_fields(built / "reference" / "defenses.html", LDP)["epsilon"] == f"{comment} TYPE: float DEFAULT: 10.0"
    assert read_fields(built / "reference" / "metrics.html", PSNR)["unit"] == "'dB' TYPE: str"


def list_flat_lists(page: str) -> list[str]:
    """Return the lines of paragraphs that GitHub shows as items of a list."""
    paragraphs = re.findall(r"<p>(.*?)</p>", re.sub(r"<pre\b.*?</pre>", "", page, flags=re.DOTALL), re.DOTALL)
    return [line for text in paragraphs for line in text.splitlines()[1:] if re.match(r"([-*+]|\d+\.) ", line)]


@pytest.mark.slow
def test_lists_are_lists(built: Path) -> None:
    for page in built.rglob("*.html"):
        assert not list_flat_lists(page.read_text(encoding="utf-8")), page
    assert list_flat_lists("<p>Text:\n- one\n- two</p>\n<pre>\n- three</pre>") == ["- one", "- two"]


GOOD = "# Title\n\n[a](#title) [b](../LICENSE)\n"


@pytest.fixture
def pages(tmp_path: Path) -> Path:
    """A folder with one page without a fault, in a repository with a license."""
    (tmp_path / "LICENSE").write_text("Free")
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "index.md").write_text(GOOD)
    return tmp_path / "docs"


def build_pages(pages: Path) -> Path:
    return build_site(pages.parent / "site", docs_dir=str(pages), nav=["index.md"])


@pytest.mark.slow
def test_files_outside_the_documents_are_part_of_the_site(pages: Path) -> None:
    site = build_pages(pages)
    assert (site / "repository" / "LICENSE.txt").read_text() == "Free"
    assert 'href="repository/LICENSE.txt"' in (site / "index.html").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault", ["[a](gone.md)", "[a](#gone)", "[a](../gone.py)", "[a](folder/)", "![a](gone.png)", "::: bench.types.gone"]
)
def test_a_page_with_a_fault_fails_the_build(fault: str, pages: Path) -> None:
    (pages / "index.md").write_text(f"{GOOD}\n{fault}\n")
    with pytest.raises(Abort):
        build_pages(pages)


@pytest.mark.slow
def test_a_page_outside_the_navigation_fails_the_build(pages: Path) -> None:
    (pages / "lost.md").write_text(GOOD)
    with pytest.raises(Abort):
        build_pages(pages)


# ---- in a browser


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with open_browser() as opened:
        yield opened.new_context()  # one for all pages, which share its cache


def is_remote(address: str) -> bool:
    return re.match("file:|data:|about:", address) is None


def open_page(browser: Any, page: Path, width: int) -> tuple[Any, list[str]]:
    """Open a page, and return it with its list of faults, which grows while it is used."""
    opened = browser.new_page()
    opened.set_viewport_size({"width": width, "height": 900})
    opened.set_default_timeout(10_000)
    faults: list[str] = []
    opened.on("console", lambda message: faults.append(f"console: {message.text}"))
    opened.on("pageerror", lambda error: faults.append(f"error: {error}"))
    opened.on("request", lambda request: faults.append(f"request: {request.url}") if is_remote(request.url) else None)
    opened.goto(page.as_uri())
    if opened.evaluate("document.documentElement.scrollWidth > document.documentElement.clientWidth"):
        faults.append("wider than the window")
    return opened, faults


@pytest.mark.exhaustive
@pytest.mark.parametrize("width", [1280, 390])
def test_pages_have_no_fault_in_a_browser(browser: Any, built: Path, width: int) -> None:
    pages = sorted(path for path in built.rglob("*.html") if path.name != "404.html")  # which a server shows at any address
    assert len(pages) > 30
    for page in pages:
        opened, faults = open_page(browser, page, width)
        opened.close()
        assert not faults, page


@pytest.mark.exhaustive
def test_faults_are_found_in_a_browser(browser: Any, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text('<p style="width: 999px">a</p><img src="http://other.invalid/a.png"><script>console.log(1); gone()</script>')
    opened, faults = open_page(browser, page, 390)
    opened.close()
    kinds = {fault.partition(":")[0] for fault in faults}
    assert kinds == {"console", "error", "request", "wider than the window"}


@pytest.mark.exhaustive
def test_wide_tables_scroll_on_a_phone(browser: Any, built: Path) -> None:
    page, faults = open_page(browser, built / "results" / "table2.html", 390)
    frame = page.locator(".md-typeset__scrollwrap").first
    assert frame.evaluate("box => box.scrollWidth > box.clientWidth")
    assert frame.evaluate("box => { box.scrollLeft = 50; return box.scrollLeft; }") == 50
    page.close()
    assert not faults


@pytest.mark.exhaustive
def test_search_works_from_the_disk(browser: Any, built: Path) -> None:
    page, faults = open_page(browser, built / "index.html", 1280)
    page.locator(".md-search__input").click()
    page.keyboard.type("PrivUnit")
    page.locator(".md-search-result__link", has_text="PrivUnit").first.click()
    page.wait_for_url("**/reference/defenses.html**")
    page.close()
    assert not faults
