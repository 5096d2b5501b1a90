"""What filters do when sensors misbehave."""
