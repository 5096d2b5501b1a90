"""Where in an interaction a person is who pauses, starts late or starts over."""
