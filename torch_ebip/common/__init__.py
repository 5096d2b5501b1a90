"""The ground: a caller's modes, arguments, guarded files, random draws, what tensors mean."""
