"""Registration of pairs of images."""
