"""Holographic displays with a camera in the loop: find what a bench does, and compute patterns that look right on it.

A holographic display is a phase-only spatial light modulator (SLM, here: panel) that is lit by a laser. The gray
levels sent to it (here: pattern) are a phase hologram. This module names what is public in Python; the commands
`hololoop-trainer` and `hololoop-runtime` do the same and more. Nothing heavy is imported before it is used.

    import hololoop

    captures = hololoop.read_captures("captures/")
    explanation = hololoop.explain(captures)
    explanation.figure().savefig("explanation.png")
    hololoop.export(explanation.model, captures, "bundle/")

    solver = hololoop.Solver("bundle/")
    solver.solve("picture.png", fit=True).save("pattern.png")

Import it before torch: threads then wait asleep instead of spinning, which is what keeps this quick on a machine with
other work. In a notebook the results show themselves. `Solver` needs the base install alone; everything else needs the
workstation's packages: pip install 'hololoop[trainer]'.

Other modules of the packages `trainer`, `runtime` and `firmware_iface` may change between versions. These names
keep their meaning: a change is announced in CHANGELOG.md.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from runtime.program.large_blocks import keep_large_blocks
from runtime.program.threads import wait_asleep

if TYPE_CHECKING:
    from firmware_iface.errors import DeviceError, InputError
    from runtime.solver.bundle_solver import BundleSolver as Solver
    from runtime.solver.bundle_solver import PatternResult
    from trainer.captures.capture_set import CaptureSet, read_captures
    from trainer.model.model import Model
    from trainer.notebook.results import CheckResult, ComparisonResult, DiagnosisResult, ExplanationResult
    from trainer.notebook.steps import check, compare, diagnose, explain, export, read_model, write_model

__all__ = [
    "CaptureSet",
    "CheckResult",
    "ComparisonResult",
    "DeviceError",
    "DiagnosisResult",
    "ExplanationResult",
    "InputError",
    "Model",
    "PatternResult",
    "Solver",
    "check",
    "compare",
    "diagnose",
    "explain",
    "export",
    "read_captures",
    "read_model",
    "write_model",
]

# As the programs do: for the whole process, before anything is loaded that reads it.
wait_asleep()
keep_large_blocks()

# Where each name is defined: (module, name there).
_DEFINED_IN = {
    "CaptureSet": ("trainer.captures.capture_set", "CaptureSet"),
    "CheckResult": ("trainer.notebook.results", "CheckResult"),
    "ComparisonResult": ("trainer.notebook.results", "ComparisonResult"),
    "DeviceError": ("firmware_iface.errors", "DeviceError"),
    "DiagnosisResult": ("trainer.notebook.results", "DiagnosisResult"),
    "ExplanationResult": ("trainer.notebook.results", "ExplanationResult"),
    "InputError": ("firmware_iface.errors", "InputError"),
    "Model": ("trainer.model.model", "Model"),
    "PatternResult": ("runtime.solver.bundle_solver", "PatternResult"),
    "Solver": ("runtime.solver.bundle_solver", "BundleSolver"),
    "check": ("trainer.notebook.steps", "check"),
    "compare": ("trainer.notebook.steps", "compare"),
    "diagnose": ("trainer.notebook.steps", "diagnose"),
    "explain": ("trainer.notebook.steps", "explain"),
    "export": ("trainer.notebook.steps", "export"),
    "read_captures": ("trainer.captures.capture_set", "read_captures"),
    "read_model": ("trainer.notebook.steps", "read_model"),
    "write_model": ("trainer.notebook.steps", "write_model"),
}
_OWN = ("trainer", "runtime", "firmware_iface")


def __getattr__(name: str) -> Any:
    """Import what a public name stands for, when it is first used (PEP 562)."""
    if name not in _DEFINED_IN:
        raise AttributeError(f"module 'hololoop' has no attribute '{name}'")
    module, there = _DEFINED_IN[name]
    try:
        value = getattr(import_module(module), there)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] in _OWN:
            raise
        raise ImportError(
            f"hololoop.{name} needs {error.name}, which is not installed; "
            "get it with: pip install 'hololoop[trainer]'"
        ) from error
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names."""
    return sorted(__all__)
