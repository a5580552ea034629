"""Labelled scenes of an episode."""
