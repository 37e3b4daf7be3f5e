"""The documentation: the site builds without a warning and has every public name; links and names lead somewhere."""

from __future__ import annotations

import importlib
import os
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import hdmi

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]

# modules whose public names are those they define, because no package lists them
MODULES = [
    "hdmi.assembly",
    "hdmi.config",
    "hdmi.errors",
    "hdmi.tasks.catalogue",
    "hdmi.tasks.check",
    "hdmi.tasks.gallery",
    "hdmi.workshop.human",
    "hdmi.workshop.ik",
    "hdmi.workshop.recording",
    "hdmi.workshop.skeleton",
    "hdmi.workshop.view.browser",
    "hdmi.workshop.view.curves",
    "hdmi.workshop.view.scene",
]

# paths in the pages that are the reader's to fill in or to write
ENTRY_POINTS = {"hdmi.configs"}  # a group of them, no module
READERS = {"conf/task/carry_vase.yaml", "conf/task/press_crate.yaml", "hdmi/motion/references/NAME"}


def public_names() -> dict[str, list[str]]:
    """Names by module: each package's `__all__`, and what `MODULES` define."""
    names = {}
    for info in pkgutil.walk_packages(hdmi.__path__, "hdmi."):
        if info.ispkg and (listed := getattr(importlib.import_module(info.name), "__all__", None)):
            names[info.name] = list(listed)
    for name in MODULES:
        items = vars(importlib.import_module(name)).items()
        names[name] = [key for key, value in items if getattr(value, "__module__", None) == name and key[0] != "_"]
    return names


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built with warnings as errors."""
    pytest.importorskip("mkdocs", reason="needs the extra docs")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    env = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    result = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stdout + result.stderr
    return folder


@pytest.mark.xdist_group("site")
def test_every_public_name_is_in_the_reference(site: Path) -> None:
    anchors = set()
    for page in (site / "reference").glob("*.html"):
        anchors |= set(re.findall(r'id="(hdmi\.[\w.]+)"', page.read_text(encoding="utf-8")))
    wanted = {f"{module}.{name}" for module, names in public_names().items() for name in names}
    assert len(wanted) > 150
    assert not sorted(wanted - anchors)


@pytest.mark.xdist_group("site")
def test_the_site_loads_nothing_from_elsewhere(site: Path) -> None:
    for page in site.rglob("*.html"):
        html = page.read_text(encoding="utf-8")
        loaded = re.findall(r'<(?:script|img|iframe)[^>]* src="([^"]*)"', html)
        loaded += re.findall(r'<link[^>]* rel="(?:stylesheet|icon|preconnect|preload)"[^>]*>', html)
        assert not [item for item in loaded if "//" in item], page.name


def without_code(markdown: str) -> str:
    return re.sub(r"`[^`\n]*`", "", re.sub(r"^```.*?^```", "", markdown, flags=re.M | re.S))


def headings(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    lines = re.findall(r"^#+ +(.+?)(?: *\{ #([\w.]+) \})?$", text, flags=re.M)
    return {given or re.sub(r"[^\w\- ]", "", line.lower()).replace(" ", "-") for line, given in lines}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    text = without_code(page.read_text(encoding="utf-8"))
    links = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'(?:src|href)="([^"]+)"', text)
    for link in links:
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        assert target.is_relative_to(ROOT), link
        assert not anchor or anchor in headings(target), link


def test_names_of_the_package_in_the_documentation_exist() -> None:
    """`hdmi.x.y` in pages, docstrings and comments, and paths of the repository in pages."""
    sources = [*PAGES, *sorted((ROOT / "hdmi").rglob("*.py")), *sorted((ROOT / "conf").rglob("*.yaml"))]
    wrong = []
    for file in sources:
        text = file.read_text(encoding="utf-8")
        for name in sorted(set(re.findall(r"(?<![\w./-])hdmi(?:\.[A-Za-z_]\w*)+", text)) - ENTRY_POINTS):
            try:
                pkgutil.resolve_name(name)
            except (ImportError, AttributeError):
                wrong.append(f"{file.relative_to(ROOT)}: {name}")
        if file.suffix == ".md":
            paths = set(re.findall(r"(?<![\w./-])(?:hdmi|scripts|conf|tests|docs|zoo)/[\w/.-]*\w", text)) - READERS
            wrong += [f"{file.relative_to(ROOT)}: {path}" for path in sorted(paths) if not (ROOT / path).exists()]
    assert not wrong
