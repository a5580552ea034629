"""Where the service runs; `deploy.ray` is the one part that is code."""
