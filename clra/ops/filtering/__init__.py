"""Filters of radiographs for filtered back-projection, and Fourier transforms."""
