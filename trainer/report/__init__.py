"""Reports: one self-contained HTML file with the error of a model, its place and its likely cause."""

from trainer.report.html_report import write_report

__all__ = ["write_report"]
