"""Who holds the members."""
