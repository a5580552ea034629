"""Scenes of recorded drives: one's own folder, nuScenes, comma2k19."""
