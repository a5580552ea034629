"""The response language: the pieces of a declaration, used to decode, parse, train and export."""
