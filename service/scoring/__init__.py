"""Scores of trajectories and feedback by rule; no engine has a part in it."""
