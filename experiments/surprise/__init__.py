"""What filters say of interactions that nobody showed them, and of sensors that lie."""
