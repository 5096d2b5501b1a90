"""Filters left running for a million steps: whether anything becomes infinite, slow or large."""
