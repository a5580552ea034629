"""The HTTP service, its page and its commands."""

if __name__ != "looktwice.service":
    raise ImportError(f"{__name__} is looktwice.service; import it by that name")
