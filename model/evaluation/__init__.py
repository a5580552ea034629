"""Open-loop evaluation: measures per scene, tables with intervals, pictures."""
