"""History: total order of messages, checkpoints, rewind for out-of-sequence ones; only a rewind writes the state."""
