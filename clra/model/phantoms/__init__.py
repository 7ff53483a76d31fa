"""Phantoms whose line integrals have a closed form, and motions to simulate."""
