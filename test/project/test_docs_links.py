# SPDX-License-Identifier: Apache-2.0
"""What the pages link to and name exists."""

import re
from pathlib import Path
from typing import get_args

import pytest
import yaml

from sim_bridge.scenario.events import Event
from sim_bridge.scenario.scenario import load_scenario

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = "viability_bounds_pkg|torque_safety_controller|sim_bridge|franka_bridge"
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("**/*.md")])
FOLDERS = (
    ".ci",
    "benchmarks",
    "config",
    "docs",
    "examples",
    "reproduction",
    "scripts",
    "src",
    "test",
)
FILES = {
    path.relative_to(ROOT).as_posix()
    for folder in FOLDERS
    for path in (ROOT / folder).rglob("*")
    if "__pycache__" not in path.parts
} | {path.name for path in ROOT.iterdir()}

OF_THE_READER = {"goal.py"}
"""Files that a page asks its reader to write."""


def anchors(page):
    """Return the anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in headings}


def links(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    found = re.findall(r"\]\(([^)]+)\)", text)
    found += re.findall(r"^\[[^\]]+\]: (\S+)$", text, re.MULTILINE)
    return {each for each in found if "://" not in each}


def module_exists(name):
    """Return whether a dotted name begins with a module of the project and a name in it."""
    path, *rest = ROOT / "src" / name.split(".")[0], *name.split(".")
    while rest and (path / rest[0]).is_dir():
        path /= rest.pop(0)
    if rest and (path / f"{rest[0]}.py").exists():
        path /= f"{rest.pop(0)}.py"
    if not rest:
        return True
    source = path if path.suffix else path / "__init__.py"
    return bool(re.search(rf"\b{rest[0]}\b", source.read_text()))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_what_a_page_links_to_and_names_exists(page):
    for link in links(page):
        target, _, anchor = link.partition("#")
        file = page.parent / target if target else page
        assert file.exists(), link
        if anchor:
            assert anchor in anchors(file), link
    for name in re.findall(r"`([^`\n]+)`", page.read_text()):
        if re.fullmatch(r"[\w./-]+\.(py|sh|md)", name) and name not in OF_THE_READER:
            assert any(f"/{each}".endswith(f"/{name}") for each in FILES), name
        if re.fullmatch(rf"({PACKAGES})(\.\w+)+", name):
            assert module_exists(name), name


def test_every_page_is_in_the_navigation_of_the_site():
    shown = set(re.findall(r"[\w/]+\.md", (ROOT / "mkdocs.yml").read_text()))
    docs = ROOT / "docs"
    assert shown == {page.relative_to(docs).as_posix() for page in docs.rglob("*.md")}


def test_release_has_one_version():
    released = re.findall(
        r"^## \[(\d[\d.]*)\] - (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.M
    )
    version, date = released[0]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert (citation["version"], citation["date-released"]) == (version, date)


def test_the_scenarios_shown_load_and_leave_no_event_out(tmp_path):
    path, events = tmp_path / "scenario.yaml", []
    text = (ROOT / "docs" / "guides" / "simulation.md").read_text()
    for example in re.findall(r"```yaml\n(.*?)```", text, re.DOTALL):
        path.write_text(example)
        events += load_scenario(path).events
    assert {type(event) for event in events} == set(get_args(Event))


def test_the_tests_that_claims_rest_on_exist():
    named = re.findall(r"`(\S+\.py)::(\w+)`", (ROOT / "docs" / "safety.md").read_text())
    assert len(named) > 10
    for file, function in named:
        source = (ROOT / file).read_text()
        assert re.search(rf"^def {function}\(", source, re.MULTILINE), f"{file}::{function}"
