"""Who imports whom: trainer -> runtime -> firmware_iface, and torch in the trainer only."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("trainer", "runtime", "firmware_iface")
FORBIDDEN = {
    "trainer": set(),
    "runtime": {"torch", "torchvision", "trainer"},
    "firmware_iface": {"torch", "torchvision", "trainer", "runtime"},
}
VENDOR = {"depthai", "usb", "smbus2"}  # imported when a device is opened


def imports(node: ast.AST, deferred: bool = False) -> Iterator[tuple[str, int, bool]]:
    """Every absolute import: top-level package, line, whether it happens after the module's own import."""
    if isinstance(node, ast.Import):
        for alias in node.names:
            yield alias.name.split(".")[0], node.lineno, deferred
    elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
        yield node.module.split(".")[0], node.lineno, deferred
    elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
        called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        name = node.args[0].value
        if called in ("import_module", "__import__") and isinstance(name, str):
            yield name.split(".")[0], node.lineno, deferred
    if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
        for child in node.body:
            yield from imports(child, deferred=True)
        for child in node.orelse:
            yield from imports(child, deferred)
        return
    later = deferred or isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
    for child in ast.iter_child_nodes(node):
        yield from imports(child, later)


def violations(package: str, source: str, where: str = "source") -> list[str]:
    found = []
    for name, line, deferred in imports(ast.parse(source)):
        if name in FORBIDDEN[package]:
            found.append(f"{where}:{line}: {package} must not import {name}")
        if name in VENDOR and not deferred:
            found.append(f"{where}:{line}: {name} is imported with the module, not when a device is opened")
    return found


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_imports_only_what_is_below_it(package: str) -> None:
    found = []
    for path in sorted((ROOT / package).rglob("*.py")):
        found += violations(package, path.read_text(encoding="utf-8"), str(path.relative_to(ROOT)))
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("package", "source", "count"),
    [
        ("runtime", "import torch", 1),
        ("runtime", "def f():\n    from torch.fft import fft2", 1),
        ("runtime", "import importlib\nimportlib.import_module('torch.nn')", 1),
        ("runtime", "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import torch", 1),
        ("runtime", "from trainer.captures.capture_set import read", 1),
        ("runtime", "from firmware_iface import errors\nimport numpy", 0),
        ("firmware_iface", "import runtime.bundle.whole_files", 1),
        ("firmware_iface", "import usb.core", 1),
        ("firmware_iface", "try:\n    import depthai as dai\nexcept ImportError:\n    dai = None", 1),
        ("firmware_iface", "class Camera:\n    import depthai", 1),
        ("firmware_iface", "class Camera:\n    def open(self):\n        import depthai", 0),
        ("firmware_iface", "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import smbus2", 0),
        ("trainer", "import torch, runtime.bundle.whole_files, firmware_iface", 0),
        ("trainer", "from smbus2 import SMBus", 1),
    ],
)
def test_the_check_sees(package: str, source: str, count: int) -> None:
    assert len(violations(package, source)) == count


@pytest.mark.parametrize("package", ["runtime", "firmware_iface"])
def test_importing_every_module_brings_neither_torch_nor_a_vendors_library(package: str) -> None:
    """Also not by way of something else that is imported."""
    modules = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for path in sorted((ROOT / package).rglob("*.py"))
        if path.name != "__main__.py"
    ]
    script = (
        "import importlib, json, sys\n"
        f"for name in {modules!r}: importlib.import_module(name)\n"
        "print(json.dumps(sorted(name for name in sys.modules if '.' not in name)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    loaded = set(json.loads(done.stdout.splitlines()[-1]))
    assert package in loaded
    assert not loaded & ({"torch", "trainer"} | VENDOR)
