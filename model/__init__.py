"""The driving model: language, network, decoding, learning. Knows no HTTP."""
