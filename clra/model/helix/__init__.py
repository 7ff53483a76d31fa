"""Helical trajectories: fitted to a scan, their gaps, and what exact methods need of them."""
