"""How the files hang together: no circles of imports, one name for one thing, and rooms that know only those below."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("trainer", "runtime", "firmware_iface")
# A driver and the model of the same part share the part's name.
DRIVERS_AND_MODELS = {
    "ads1115.py",
    "dlpc900.py",
    "laser_board.py",
    "mcp23008.py",
    "mcp4728.py",
    "panel_board.py",
    "safety_controller.py",
    "tmp117.py",
}
# What stands below a room of the trainer; a room imports from these alone. `testing` and the file that `new-effect`
# writes serve the tests of effects, and see all that such a test needs.
BELOW = {
    "captures": set(),
    "prediction": {"captures"},
    "effects": {"captures", "prediction"},
    "model": {"captures", "prediction", "effects", "networks"},
    "fitting": {"captures", "prediction", "effects", "model"},
    "diagnosis": {"captures", "prediction", "effects", "model", "fitting", "networks", "training"},
    "fleet": {"captures", "prediction", "effects", "model", "fitting", "diagnosis", "report"},
    "studio": {
        "captures",
        "prediction",
        "effects",
        "model",
        "fitting",
        "diagnosis",
        "networks",
        "training",
        "report",
    },
}
FOR_TESTS_OF_EFFECTS = ("trainer.effects.testing", "trainer.effects.new_effect.effect_test_template")


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def modules() -> dict[str, Path]:
    return {module_of(p): p for package in PACKAGES for p in sorted((ROOT / package).rglob("*.py"))}


def imported(source: str, known: set[str]) -> set[str]:
    """Modules of the project that a file imports, inside functions and for type checks, too."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                found.add(inner if inner in known else node.module)
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found & known


def graph() -> dict[str, set[str]]:
    files = modules()
    return {name: imported(p.read_text(encoding="utf-8"), set(files)) - {name} for name, p in files.items()}


def circles(arrows: dict[str, set[str]]) -> Iterator[list[str]]:
    """A circle of imports for each file that can reach itself, shortest way first found."""
    for start in arrows:
        came: dict[str, str] = {}
        reached = [start]
        for here in reached:
            for there in sorted(arrows.get(here, ())):
                if there == start:
                    way = [here]
                    while way[-1] != start:
                        way.append(came[way[-1]])
                    yield [*reversed(way), start]
                    break
                if there not in came:
                    came[there] = here
                    reached.append(there)
            else:
                continue
            break


def test_no_files_import_each_other_in_a_circle() -> None:
    found = [" -> ".join(circle) for circle in circles(graph())]
    assert not found, "\n".join(found)


def test_the_check_sees_a_circle() -> None:
    assert list(circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}))
    assert not list(circles({"a": {"b", "c"}, "b": {"c"}, "c": set()}))
    assert imported("def f():\n    from a import b", {"a.b", "a"}) == {"a.b"}


@pytest.mark.parametrize("package", PACKAGES)
def test_no_two_files_of_a_package_share_a_name(package: str) -> None:
    places = defaultdict(list)
    for path in (ROOT / package).rglob("*.py"):
        if path.name not in ("__init__.py", "__main__.py"):
            places[path.name].append(str(path.relative_to(ROOT)))
    twice = {name: found for name, found in places.items() if len(found) > 1}
    assert set(twice) <= DRIVERS_AND_MODELS, twice


def test_a_room_of_the_trainer_knows_only_those_below() -> None:
    found = []
    for name, targets in graph().items():
        parts = name.split(".")
        if parts[0] != "trainer" or len(parts) < 3 or parts[1] not in BELOW or name in FOR_TESTS_OF_EFFECTS:
            continue
        for target in targets:
            room = target.split(".")[1] if target.startswith("trainer.") else parts[1]
            if target.count(".") > 1 and room != parts[1] and room not in BELOW[parts[1]]:
                found.append(f"{name} imports {target}")
    assert not found, "\n".join(sorted(found))


def test_every_file_says_what_it_holds() -> None:
    silent = [
        n for n, p in modules().items() if not ast.get_docstring(ast.parse(p.read_text(encoding="utf-8")))
    ]
    assert not silent, silent
