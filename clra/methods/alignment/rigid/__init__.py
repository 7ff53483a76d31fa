"""Alignment in up to six degrees of freedom a view."""
