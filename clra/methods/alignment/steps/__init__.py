"""How an iteration goes on from a registration: extrapolation, and modes that are slow."""
