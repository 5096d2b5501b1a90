"""People who pause, start late, start over, or are slower and faster than anybody who was recorded."""
