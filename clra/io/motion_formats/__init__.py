"""Geometries and motions in other programs' formats."""
