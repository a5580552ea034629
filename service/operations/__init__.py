"""What an operator sets and sees: settings, keys, the engine's life, metrics, logs, traces."""
