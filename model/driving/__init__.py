"""The words of driving (scene, plan, trajectory) and their measures, over numpy only."""
