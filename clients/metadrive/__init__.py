"""Scenes from MetaDrive: maps and models of the simulator, an expert that drives among hazards, pictures.

Others come in by three doors, and import from nothing else:

* `looktwice.clients.metadrive.generation` writes scene files.
* `looktwice.clients.metadrive.closed_loop` drives through episodes with a pilot, and films it.
* `looktwice.clients.metadrive.outcomes` follows plans in the worlds of scenes that were generated.

MetaDrive itself is imported by `looktwice.clients.metadrive.simulator` alone, once a map is made or a picture
is drawn.
"""
