"""The driving model: language, network, decoding, learning. Knows no HTTP."""

if __name__ != "looktwice.model":
    raise ImportError(f"{__name__} is looktwice.model; import it by that name")
