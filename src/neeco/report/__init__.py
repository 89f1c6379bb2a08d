"""The one-page report of a run."""

from neeco.report.run_page import write_report

__all__ = ["write_report"]
