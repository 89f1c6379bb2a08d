"""The one-page report of a run."""

from neeco.report.page import write_report

__all__ = ["write_report"]
