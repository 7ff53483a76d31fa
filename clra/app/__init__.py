"""The command line: commands, progress, reports, simulation and demonstration."""
