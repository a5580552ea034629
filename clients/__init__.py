if __name__ != "looktwice.clients":
    raise ImportError(f"{__name__} is looktwice.clients; import it by that name")
