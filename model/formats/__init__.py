"""The response language: one declaration per model family, used to decode, parse, train and export."""
