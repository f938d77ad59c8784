"""One thin file a subcommand: parse, call, report."""
