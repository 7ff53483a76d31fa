"""Corrections of radiographs: what the detector and the beam did to them."""
