"""One HTML page, with everything in it, about a run or a catalog; a run's layout for Foxglove."""

from optnav_cli.report.foxglove_layout import write_layout
from optnav_cli.report.write import write_report

__all__ = ["write_layout", "write_report"]
