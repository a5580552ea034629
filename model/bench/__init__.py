"""Engines side by side: the same checkpoint, scenes and controls, each engine in a process of its own."""
