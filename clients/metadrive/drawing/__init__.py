"""What an episode looks like: meshes, the stage, cameras."""
