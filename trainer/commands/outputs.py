"""Where several commands write: --out and --report, and what the folders hold that they write."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from runtime.program.outputs import Output, files_written

BUNDLE = ("bundle.json", "*.safetensors", "*.onnx")
CAPTURES = ("bench.toml", "captures.csv", "phase", "image")
PROPOSALS = ("drive_*.py", "panel_*.py", "pupil_*.py", "sensor_*.py", "__pycache__")
ROUNDS = ("round-*",)
RUN = ("checkpoint.pt", "network.safetensors", "curves", "running")
UNFINISHED_RUN = ("checkpoint.pt", "curves", "running")
DEMO = ("captures", "model.toml", "model*.safetensors", "report.html", "bundle", "bundle-ideal", "patterns")


def out_option(parser: ArgumentParser, metavar: str, what: str, required: bool = True) -> None:
    """--out."""
    parser.add_argument("--out", metavar=metavar, type=Path, required=required, help=what)


def report_option(parser: ArgumentParser) -> None:
    """--report."""
    parser.add_argument(
        "--report", metavar="FILE.html", type=Path, help="write a report with pictures, one HTML file"
    )


def model_out(args: Namespace) -> list[Output]:
    """The model that goes to --out, which may replace the one that it goes on from, and a report."""
    model = Output(args.out, goes_on_from=args.model)
    return [model, *files_written(report=getattr(args, "report", None))]


def report_out(args: Namespace) -> list[Output]:
    """The report."""
    return files_written(report=args.report)
