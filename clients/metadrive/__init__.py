"""Scenes from MetaDrive: maps and models of the simulator, an expert that drives among hazards, pictures."""
