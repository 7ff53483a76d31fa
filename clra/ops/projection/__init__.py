"""Projectors along rays of a cone beam, and their adjoints."""
