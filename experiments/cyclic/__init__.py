"""Interactions that repeat: a phase on a circle beside one that goes on once."""
