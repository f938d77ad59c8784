"""Methods that turn pictures into positions, one file each."""
