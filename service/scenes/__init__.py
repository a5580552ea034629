"""Labelled scenes: the bundled ones, and those of a file."""
