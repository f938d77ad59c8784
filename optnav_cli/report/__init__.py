"""One HTML page, with everything in it, about a run or a catalog."""

from optnav_cli.report.write import write_report

__all__ = ["write_report"]
