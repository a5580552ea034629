"""Learning: targets, grounding, recipes, the trainer."""
