"""What happens in an episode: roads, who is on them, and what comes of it otherwise. Nothing is drawn."""
