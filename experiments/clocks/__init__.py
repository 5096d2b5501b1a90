"""Clocks that disagree: what a session makes of them."""
