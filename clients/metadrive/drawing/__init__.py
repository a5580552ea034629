"""What an episode looks like: meshes, the stage, cameras; and text in pictures."""
