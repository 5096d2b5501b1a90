"""Sessions under load: whether `push` waits for anybody, and every forecast is in time."""
