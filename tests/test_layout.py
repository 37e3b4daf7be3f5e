"""Dependencies point one way, and names say where things are."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# From what depends on nothing to what depends on everything: a part may import those of the lines above it, and itself.
LAYERS = (
    ("console", "errors", "metrics", "names", "threads"),
    ("functional",),
    ("assets",),
    ("motion",),
    ("envs", "transforms"),
    ("config",),
    ("order",),
    ("assembly",),
    ("learning",),
    ("deploy",),
    ("evaluation",),
    ("workshop",),
    ("tasks",),
    ("studies",),
    ("commands",),
    ("__main__",),
)
LEVEL = {part: level for level, parts in enumerate(LAYERS) for part in parts}
MODULES = {path.relative_to(ROOT): path for path in sorted((ROOT / "hdmi").rglob("*.py"))}


def part_of(module: Path) -> str:
    """What stands directly under hdmi/: a package or a module."""
    return module.parts[1].removesuffix(".py")


def imported(path: Path) -> Iterator[tuple[int, str]]:
    """Lines and dotted names of all imports, those in functions, too; of `from a import b` the name a.b."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative"
            yield from ((node.lineno, f"{node.module}.{alias.name}") for alias in node.names)


def parts_imported(path: Path) -> Iterator[tuple[int, str]]:
    """Lines and parts of hdmi that a file imports."""
    for line, name in imported(path):
        if name.split(".")[0] == "hdmi" and name != "hdmi":
            yield line, name.split(".")[1]


def test_every_part_has_its_place():
    there = {part_of(module) for module in MODULES if module != Path("hdmi/__init__.py")}
    assert there == set(LEVEL)
    assert not list(imported(ROOT / "hdmi" / "__init__.py"))


@pytest.mark.parametrize("part", LEVEL)
def test_no_arrow_points_upwards(part: str):
    wrong = [
        f"{module}:{line} imports hdmi.{other}"
        for module, path in MODULES.items()
        if part_of(module) == part
        for line, other in parts_imported(path)
        if other != part and LEVEL[other] >= LEVEL[part]
    ]
    assert not wrong


def test_what_trains_knows_nothing_of_the_workshop():
    below = [part for part in LEVEL if LEVEL[part] <= LEVEL["learning"]]
    wrong = [
        str(module)
        for module, path in MODULES.items()
        if part_of(module) in below and "workshop" in {other for _, other in parts_imported(path)}
    ]
    assert not wrong


def test_scripts_call_commands_and_nothing_else():
    for path in (*sorted((ROOT / "scripts").glob("*.py")), ROOT / "train.py"):
        assert {part for _, part in parts_imported(path)} == {"commands"}, path


def test_the_readme_states_the_order():
    line = " <- ".join(", ".join(parts) for parts in LAYERS[1:-1])
    text = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    assert f"{line} <- scripts" in text


def test_no_module_is_called_as_its_package():
    assert not [str(module) for module in MODULES if module.stem == module.parent.name]


def test_a_report_is_of_one_thing():
    assert len([module for module in MODULES if module.name == "report.py"]) <= 1


def test_finds_imports_in_functions(tmp_path: Path):
    path = tmp_path / "module.py"
    path.write_text(
        "import os\ndef f():\n    from hdmi.learning import x\n    import hdmi.envs.backend\nfrom hdmi import order\n"
    )
    assert sorted(parts_imported(path)) == [(3, "learning"), (4, "envs"), (5, "order")]
