"""Labelled scenes of an episode, and what scene files contain."""
