"""From a request to the engine and back: checks, events, answers."""
