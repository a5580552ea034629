"""LookTwice: a server for driving models that look twice before they act."""
