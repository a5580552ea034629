"""Who is let in: places for draws, and rates for each caller."""
