"""Load on a running service: what is sent, what comes back, how fast."""

if __name__ != "looktwice.loadtests":
    raise ImportError(f"{__name__} is looktwice.loadtests; import it by that name")
