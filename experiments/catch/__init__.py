"""The closed loop of the paper's section V: a simulated arm catches balls by what sensors say (`python -m`)."""
