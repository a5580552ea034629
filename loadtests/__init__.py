if __name__ != "looktwice.loadtests":
    raise ImportError(f"{__name__} is looktwice.loadtests; import it by that name")
