"""One HTML page, with everything in it, about a run or a catalog; a run's layout for Foxglove."""

from optnav_cli.pages import write_report
from optnav_cli.report.foxglove_layout import write_layout

__all__ = ["write_layout", "write_report"]
