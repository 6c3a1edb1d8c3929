"""Reports: one self-contained HTML file that says at a glance how far a model is off, where and why."""

from trainer.report.write import write_report

__all__ = ["write_report"]
