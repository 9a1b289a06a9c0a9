"""README.md and docs/: every link leads somewhere, the site needs no network, tables are true."""

import logging
import re
import tomllib
from html.parser import HTMLParser
from pathlib import Path

import pytest
import yaml
from mkdocs.commands.build import build
from mkdocs.config import load_config
from mkdocs.exceptions import Abort

from docs.result_tables import pages
from tests.conftest import ROOT

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def built(site: Path, **changes: object) -> None:
    """Build the site strictly, as `make docs` does."""
    config = load_config(str(ROOT / "mkdocs.yml"), site_dir=str(site), strict=True, **changes)
    build(config)


class Loaded(HTMLParser):
    """What a page makes a browser load."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        if tag == "link" and given.get("rel") not in ("canonical", "prev", "next"):
            self.addresses.append(given["href"])
        elif "src" in given:
            self.addresses.append(given["src"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The whole site; a link or an anchor to nothing, or a page outside of the menu, stops it."""
    folder = tmp_path_factory.mktemp("site")
    built(folder)
    return folder


SHIPPED = {p.relative_to(ROOT / "docs") for p in (ROOT / "docs").rglob("*.html")}
"""Reports of sweeps: pages that are whole in themselves."""


def test_every_page_is_built_with_files_that_it_links_to(site: Path) -> None:
    pages = {p.relative_to(ROOT / "docs").with_suffix(".html") for p in PAGES[1:]}
    there = {p.relative_to(site) for p in site.rglob("*.html")}
    named = {Path("results/index.html") if p.stem == "README" else p for p in pages}
    assert named | SHIPPED | {Path("index.html"), Path("404.html")} == there
    for text in ("source/LICENSE.txt", "source/components/algorithms/lion.py.txt"):
        assert (site / text).read_text(encoding="utf-8")
    assert "source/LICENSE.txt" in (site / "index.html").read_text(encoding="utf-8")


def test_a_page_loads_nothing_from_elsewhere(site: Path) -> None:
    for page in SHIPPED:
        assert all(address.startswith("data:") for address in Loaded(site / page).addresses)
    for page in {*site.rglob("*.html")} - {site / shipped for shipped in SHIPPED}:
        addresses = Loaded(page).addresses
        assert len(addresses) > 3
        elsewhere = [address for address in addresses if re.match(r"[a-z]+:|//", address)]
        assert elsewhere == []
        missing = [a for a in addresses if not (page.parent / a).exists() and page.stem != "404"]
        assert missing == []
    for sheet in site.rglob("*.css"):
        assert not re.findall(r"url\(['\"]?https?:", sheet.read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("link", "named"),
    [
        ("nowhere.md", "nowhere.md"),
        ("../components/nothing.py", "../components/nothing.py"),
        ("../README.md#nowhere", "index.md#nowhere"),
        ("#nowhere", "#nowhere"),
        ("/absolute.md", "/absolute.md"),
    ],
)
def test_a_link_to_nothing_stops_the_build(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, link: str, named: str
) -> None:
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "page.md").write_text(f"# A page\n\n[There]({link})\n", encoding="utf-8")
    alone = {"nav": [{"A page": "page.md"}], "docs_dir": str(tmp_path / "docs")}
    with caplog.at_level(logging.WARNING), pytest.raises(Abort):
        built(tmp_path / "site", **alone)
    assert any("'page.md' contains" in line and named in line for line in caplog.messages)


def test_links_of_the_front_page_exist_where_it_stands() -> None:
    text = PAGES[0].read_text(encoding="utf-8")
    links = re.findall(r'\]\(([^)]+)\)|src="([^"]+)"', text)
    paths = {(a or b).partition("#")[0] for a, b in links}
    assert len(paths) > 15
    assert [path for path in paths if not (ROOT / path).is_file()] == []


def test_the_tables_are_those_of_the_data() -> None:
    for page in pages.PAGES:
        text = page.read_text(encoding="utf-8")
        assert "<!-- table " in text
        assert pages.filled(text) == text, "Run `python -m docs.result_tables`."


def test_a_table_is_made_anew_and_holds_what_was_measured() -> None:
    stale = "Before.\n<!-- table front -->\n| old |\n<!-- end of front -->\nAfter.\n"
    made = pages.filled(stale)
    assert made.startswith("Before.\n")
    assert made.endswith("\nAfter.\n")
    assert "old" not in made
    # (324.45 + 286.19 + 229.64 + 158.82 + 119.46) / 5, and 1,131 / 5 of the thesis
    assert "| TD3+BC | -223.7 (-226.2) |" in made
    assert (
        "| bad-0.0 | -326.9 ▼ | -313.0 (1) |" in pages.TABLES["beside"]()
    )  # 13.9 apart, errors 5.2
    assert "| **-71.0** (1.0) at 0.65 | -251.0 (45.7) |" in pages.TABLES["full"]()
    with pytest.raises(KeyError):
        pages.filled("<!-- table none -->\n<!-- end of none -->")


def test_the_licence_and_the_citation_agree_with_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    licence = (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert project["license"] == citation["license"] == "Apache-2.0"
    assert project["version"] == citation["version"]
    assert "Apache License" in licence
    assert "END OF TERMS AND CONDITIONS" in licence
    [thesis] = [work for work in citation["references"] if work["type"] == "thesis"]
    front = " ".join(PAGES[0].read_text(encoding="utf-8").split())
    assert thesis["title"] in front
    [author] = thesis["authors"]
    assert f"{author['given-names']} {author['family-names']}" in front
