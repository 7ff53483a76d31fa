"""Statistical models of radiographs."""
