"""Parts of pages: page, sheet, svg, maps of bodies and grounds, plots of errors."""
