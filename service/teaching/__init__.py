"""What teachers are asked: reflections for labels, feedback on trajectories."""
