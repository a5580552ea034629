"""Where the service runs; `looktwice.deploy.ray` is the one part that is code."""
