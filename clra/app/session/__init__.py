"""What surrounds a command: its configuration file and its log."""
