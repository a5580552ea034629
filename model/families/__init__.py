"""Model families: what the responses of each look like, and what everything else may ask about them."""
