"""The commands, one concept a file."""
