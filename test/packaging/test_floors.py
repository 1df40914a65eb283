"""Imports run downward: a module's floor is above the floor of what it imports."""

from __future__ import annotations

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "relpose_ros"
FLOORS = (
    {"views", "estimates", "errors", "geometry"},
    {"network", "captures"},
    {"inference", "training"},
    {"scanning", "evaluation"},
    {"node", "replay"},
    {"cli"},
    {"__main__", "__init__"},
)
FLOOR_OF = {unit: floor for floor, units in enumerate(FLOORS) for unit in units}
GENERATED = {"rclpy", "std_srvs", "builtin_interfaces", "rcl_interfaces", "relpose_ros.msg"}


class Import(NamedTuple):
    source: Path
    name: str
    deferred: bool
    """Inside a function: run on use, not on import."""
    for_types: bool
    """Under TYPE_CHECKING: never run."""

    @property
    def unit(self) -> str:
        """The importing module or sub-package of relpose_ros."""
        return self.source.relative_to(PACKAGE).parts[0].removesuffix(".py")

    @property
    def top(self) -> str:
        """The imported top-level package."""
        return self.name.partition(".")[0]


def imports_of(path: Path) -> list[Import]:
    found: list[Import] = []

    def visit(node: ast.AST, deferred: bool, for_types: bool) -> None:
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            deferred = True
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            for child in node.body:
                visit(child, deferred, True)
            for child in node.orelse:
                visit(child, deferred, for_types)
            return
        if isinstance(node, ast.Import):
            found.extend(Import(path, alias.name, deferred, for_types) for alias in node.names)
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.relative_to(PACKAGE)}:{node.lineno} imports relatively"
            assert node.module is not None
            # `from relpose_ros import views` imports a module, `from relpose_ros.views import View` a name.
            bare = node.module == "relpose_ros"
            names = [f"relpose_ros.{alias.name}" for alias in node.names] if bare else [node.module]
            found.extend(Import(path, name, deferred, for_types) for name in names)
        for child in ast.iter_child_nodes(node):
            visit(child, deferred, for_types)

    visit(ast.parse(path.read_text(encoding="utf-8")), deferred=False, for_types=False)
    return found


IMPORTS = [
    found
    for path in sorted(PACKAGE.rglob("*.py"))
    if path.relative_to(PACKAGE).parts[0] != "msg"
    for found in imports_of(path)
]
OWN = [
    (found, found.name.split(".")[1]) for found in IMPORTS if found.top == "relpose_ros" and "." in found.name
]


def told(imports: list[Import]) -> list[str]:
    return sorted({f"{found.source.relative_to(PACKAGE)} imports {found.name}" for found in imports})


def test_every_module_has_a_floor() -> None:
    units = {
        path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()
    }
    assert units - {"msg", "weights"} <= set(FLOOR_OF)


def test_imports_never_run_upward() -> None:
    upward = [f for f, unit in OWN if unit not in {"msg", f.unit} and FLOOR_OF[unit] > FLOOR_OF[f.unit]]
    assert told(upward) == []


def test_the_ground_imports_nothing_of_ours() -> None:
    ground = [f for f, unit in OWN if f.unit in FLOORS[0] and unit != f.unit and not f.for_types]
    assert told(ground) == []


@pytest.mark.parametrize("of_units", [True, False], ids=["packages", "modules"])
def test_there_is_no_circle(of_units: bool) -> None:
    graph: dict[str, set[str]] = {}
    for found, unit in OWN:
        source = ".".join(("relpose_ros", *found.source.relative_to(PACKAGE).with_suffix("").parts))
        here, there = (found.unit, unit) if of_units else (source, found.name)
        if here != there and not found.for_types:
            graph.setdefault(here, set()).add(there)
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"a circle of imports: {' -> '.join(error.args[1])}")


@pytest.mark.parametrize(("one", "other"), [("node", "replay"), ("replay", "node")])
def test_the_transports_know_neither_each_other_nor_training_nor_evaluation(one: str, other: str) -> None:
    strangers = {other, "training", "evaluation"}
    assert told([found for found, unit in OWN if found.unit == one and unit in strangers]) == []


def test_ros_is_imported_in_node_alone() -> None:
    ros = [
        found
        for found in IMPORTS
        if found.top in GENERATED or found.top.endswith("_msgs") or found.name.startswith("relpose_ros.msg")
    ]
    assert ros, "the node imports rclpy: this test reads no imports"
    assert told([found for found in ros if found.unit != "node"]) == []


def test_rosbags_is_imported_in_replay_alone() -> None:
    assert told([found for found in IMPORTS if found.top == "rosbags" and found.unit != "replay"]) == []


@pytest.mark.parametrize("heavy", ["moderngl", "pycolmap", "trimesh"])
def test_what_few_need_is_imported_on_use(heavy: str) -> None:
    eager = [f for f in IMPORTS if f.top == heavy and not f.deferred and not f.for_types]
    assert told(eager) == []
