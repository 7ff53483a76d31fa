"""From a scan to a volume: filtered back-projection, Katsevich, OSEM-TR, IMGR (Algorithm 3)."""
