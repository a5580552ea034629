"""Where the service runs; `looktwice.deploy.ray` is the one part that is code."""

if __name__ != "looktwice.deploy":
    raise ImportError(f"{__name__} is looktwice.deploy; import it by that name")
